"""What holds a body in a scene."""

from __future__ import annotations

import mujoco

from mjx_arm.envs.arm import Arm
from mjx_arm.scene import Scene

# A body that nothing holds falls by 5 cm meanwhile, s.
_TIME = 0.1
# So far it may sink into what it lies on, m.
_SINKS = 5e-3


def check_rests(scene: Scene, arm: Arm, height_qpos: int, name: str) -> None:
    """Rejects a body that falls from where the keyframe `home` puts it.

    Args:
      scene: the scene.
      arm: the arm in it.
      height_qpos: place of the body's height in `qpos`.
      name: what the body is called.

    Raises:
      ValueError: nothing holds the body.
    """
    model = scene.mj_model
    data = mujoco.MjData(model)
    data.qpos[:], data.ctrl[:] = arm.home_qpos, arm.home_ctrl
    before = data.qpos[height_qpos]
    while data.time < _TIME:
        mujoco.mj_step(model, data)
    fell = before - data.qpos[height_qpos]
    if fell > _SINKS:
        raise ValueError(
            f"scene {scene.name!r}: in the keyframe 'home' nothing holds the {name}, which falls "
            f"by {fell:.3f} m in {_TIME:g} s: put the ground at height 0, and let both collide"
        )
