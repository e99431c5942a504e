"""MuJoCo's own renderer, in a process of its own.

MuJoCo chooses its OpenGL when it is imported, and a machine without one must not end the command.
"""

from __future__ import annotations

import os
import pathlib
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np

_BACKENDS = ("egl", "osmesa", "glfw")
_TIMEOUT_S = 300.0


def render_by_mujoco(
    model: mujoco.MjModel, qpos: np.ndarray, camera: str, sizes: Mapping[int, bool]
) -> list[np.ndarray]:
    """Renders states by MuJoCo's renderer.

    Args:
      model: of the scene.
      qpos: `[K, nq] float32`.
      camera: a camera's name.
      sizes: edges of the square images, pixels, and whether they have shadows.

    Returns:
      For each edge `[K, edge, edge, 3] uint8`.

    Raises:
      ValueError: this machine has no OpenGL that MuJoCo can use.
    """
    given = os.environ.get("MUJOCO_GL")
    for backend in (given,) if given else _BACKENDS:
        found = _in_a_process(backend, model, qpos, camera, sizes)
        if found is not None:
            return found
    raise ValueError(
        "MuJoCo's renderer found no OpenGL: install libegl1 and libgl1-mesa-dri, or libosmesa6"
    )


def _in_a_process(
    backend: str, model: mujoco.MjModel, qpos: np.ndarray, camera: str, sizes: Mapping[int, bool]
) -> list[np.ndarray] | None:
    with tempfile.TemporaryDirectory() as name:
        folder = pathlib.Path(name)
        mujoco.mj_saveModel(model, str(folder / "scene.mjb"), None)
        np.savez(
            folder / "states.npz",
            qpos=qpos,
            camera=np.asarray(camera),
            edges=list(sizes),
            shadows=list(sizes.values()),
        )
        command = [sys.executable, "-m", "mjx_arm.reproduce.opengl", str(folder)]
        environment = os.environ | {"MUJOCO_GL": backend}
        try:
            subprocess.run(
                command, env=environment, check=True, capture_output=True, timeout=_TIMEOUT_S
            )
            with np.load(folder / "images.npz") as images:
                return [images[str(edge)] for edge in sizes]
        except (subprocess.SubprocessError, OSError):
            return None


def _render(folder: pathlib.Path) -> None:
    """What the process does: reads the states, and writes their images."""
    model = mujoco.MjModel.from_binary_path(str(folder / "scene.mjb"))
    data = mujoco.MjData(model)
    with np.load(folder / "states.npz") as states:
        poses, camera = states["qpos"], str(states["camera"])
        edges, shadows = states["edges"].tolist(), states["shadows"].tolist()
    images: dict[str, Any] = {}
    for edge, shadow in zip(edges, shadows, strict=True):
        model.vis.global_.offwidth = max(model.vis.global_.offwidth, edge)
        model.vis.global_.offheight = max(model.vis.global_.offheight, edge)
        with mujoco.Renderer(model, edge, edge) as renderer:
            own = []
            for qpos in poses:
                data.qpos[:] = qpos
                mujoco.mj_forward(model, data)
                renderer.update_scene(data, camera)
                renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = shadow
                own.append(renderer.render().copy())
        images[str(edge)] = np.stack(own)
    np.savez(folder / "images.npz", **images)


if __name__ == "__main__":
    _render(pathlib.Path(sys.argv[1]))
