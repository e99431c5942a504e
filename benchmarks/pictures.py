"""Pictures of the scene for the README: our renderer beside MuJoCo's, which needs OpenGL.

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


def main(folder: pathlib.Path) -> None:
    """Writes `scene.png`, ours above and MuJoCo's below."""
    env = mjx_arm.make("A", physics="native", observation="packed")
    policy = jax.jit(make_scripted_policy(env))
    step = jax.jit(env.transition)
    large = mjx_arm.make_renderer(env.scene, size=(EDGE, EDGE), shadows=True)
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
    folder.mkdir(parents=True, exist_ok=True)
    both = [np.concatenate(row, axis=1) for row in (ours, theirs)]
    imageio.imwrite(folder / "scene.png", np.concatenate(both, axis=0))


if __name__ == "__main__":
    main(pathlib.Path(sys.argv[1]))
