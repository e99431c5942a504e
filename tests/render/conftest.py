from __future__ import annotations

import pytest
from mujoco_reference import random_primitives

from mjx_arm.scene import Scene, load_scene


@pytest.fixture(scope="session")
def arm() -> Scene:
    return load_scene("arm_cube")


@pytest.fixture(scope="session")
def primitives() -> Scene:
    return random_primitives(seed=0)
