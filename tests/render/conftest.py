from __future__ import annotations

import os

import mujoco
import pytest
from mujoco_reference import random_primitives, scene_of

from mjx_arm.scene import Scene, load_scene


@pytest.fixture(scope="session")
def arm() -> Scene:
    return load_scene("arm_cube")


@pytest.fixture(scope="session")
def primitives() -> Scene:
    return random_primitives(seed=0)


@pytest.fixture(scope="session")
def opengl() -> None:
    """Skips where MuJoCo finds no OpenGL, unless MJX_ARM_REQUIRE_GL=1 asks to fail instead."""
    try:
        mujoco.Renderer(scene_of("<mujoco/>").mj_model, 8, 8).close()
    except Exception as error:
        reason = (
            f"no OpenGL ({type(error).__name__}: {error}): install the system package libegl1 "
            "or libosmesa6, or set MUJOCO_GL"
        )
        if os.environ.get("MJX_ARM_REQUIRE_GL") == "1":
            pytest.fail(reason)
        pytest.skip(reason)
