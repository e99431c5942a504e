"""Pictures of the scenes: our renderer beside MuJoCo's, which needs OpenGL.

MUJOCO_GL=egl python benchmarks/pictures.py docs
"""

from __future__ import annotations

import pathlib
import sys

import imageio.v3 as imageio
import jax
import mujoco
import numpy as np

import mjx_arm
from mjx_arm.envs.scripted import make_scripted_policy

# Iterations of the scripted policy that are shown.
MOMENTS = (0, 70, 150)
EDGE = 320


# File -> scene and samples of each pixel.
PICTURES = {"scene.png": ("arm_cube", 1), "desk.png": ("arm_cube_desk", 4)}


def main(folder: pathlib.Path) -> None:
    """Writes `scene.png` and `desk.png`, ours above and MuJoCo's below."""
    folder.mkdir(parents=True, exist_ok=True)
    for file, (scene, samples) in PICTURES.items():
        imageio.imwrite(folder / file, draw(scene, samples))


def draw(scene: str, samples: int) -> np.ndarray:
    """Moments of an episode by both renderers, one above the other."""
    env = mjx_arm.make("A", scene=scene, physics="native", observation="packed")
    policy = jax.jit(make_scripted_policy(env))
    step = jax.jit(env.transition)
    large = mjx_arm.make_renderer(env.scene, size=(EDGE, EDGE), shadows=True, samples=samples)
    model = env.scene.mj_model
    data = mujoco.MjData(model)
    _, state = env.reset(jax.random.key(0))
    ours, theirs = [], []
    with mujoco.Renderer(model, EDGE, EDGE) as renderer:
        for moment in range(max(MOMENTS) + 1):
            if moment in MOMENTS:
                poses = state.physics.poses
                ours.append(np.asarray(mjx_arm.rgb(large(poses.geom_xpos, poses.geom_xmat))))
                data.qpos[:] = state.physics.qpos
                mujoco.mj_forward(model, data)
                renderer.update_scene(data, env.config.cameras[0])
                theirs.append(renderer.render())
            state, _ = step(state, policy(state))
    return np.concatenate([np.concatenate(row, axis=1) for row in (ours, theirs)], axis=0)


if __name__ == "__main__":
    main(pathlib.Path(sys.argv[1]))
