"""A robot of one's own: any MJCF with the names that arm and task need. Here: without a wrist roll.

The shipped scene loses a joint and its servo, and has 12 actions instead of 14.
"""

from __future__ import annotations

import pathlib
import tempfile

import jax
import mujoco

import mjx_arm

JOINT = "forearm_roll"


def five_joints() -> str:
    """The MJCF of the shipped arm without one joint."""
    spec = mujoco.MjSpec.from_string(mjx_arm.load_scene("arm_cube").xml)
    model = spec.compile()
    key = spec.keys[0]
    qpos, ctrl = list(key.qpos), list(key.ctrl)
    del qpos[model.jnt_qposadr[model.joint(JOINT).id]], ctrl[model.actuator(JOINT).id]
    key.qpos, key.ctrl = qpos, ctrl
    spec.delete(spec.actuator(JOINT))
    spec.delete(spec.joint(JOINT))
    return spec.to_xml()


def main() -> None:
    """Steps it through all of its actions."""
    with tempfile.TemporaryDirectory() as folder:
        path = pathlib.Path(folder) / "five_joints.xml"
        path.write_text(five_joints())
        env = mjx_arm.make("A", scene=str(path), observation="state")
    obs, state = jax.jit(env.reset)(jax.random.key(0))
    print(f"{env.arm.num_joints} joints, {env.num_actions} actions, {obs.shape[0]} features")
    step = jax.jit(env.step)
    for action in range(env.num_actions):
        obs, state, *_, info = step(jax.random.key(0), state, action)
    print(f"distance to the cube {float(info['distance']):.3f} m")


if __name__ == "__main__":
    main()
