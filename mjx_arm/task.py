"""The task's own physics: what an action does to the controls, and whether the cube is grasped."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_arm.kinematics import Poses
from mjx_arm.scene import NUM_ARM_JOINTS, TaskIds

NUM_ACTIONS = 2 * NUM_ARM_JOINTS + 2
OPEN = 2 * NUM_ARM_JOINTS
CLOSE = OPEN + 1

# A pad presses where it is inside the cube, contacts being soft; this much is rounding.
_TOUCH = 1e-5


def apply_action(ids: TaskIds, ctrl: jax.Array, action: jax.Array, degrees: float) -> jax.Array:
    """Moves the target of one servo.

    Actions `2 j` and `2 j + 1` turn joint `j` by minus and plus `degrees`; `OPEN` and `CLOSE` set
    the gripper's whole travel (James & Johns 2016, section 3.2).

    Args:
      ids: the task's ids.
      ctrl: `[nu] float32`, rad and m.
      action: `[] int32`, 0 to 13.
      degrees: how far a joint turns.

    Returns:
      `[nu] float32`, clipped to the joints' ranges.
    """
    low, high = ids.ctrl_range.T
    table = np.zeros((NUM_ACTIONS, len(ctrl)), np.float32)
    for joint, index in enumerate(ids.arm_ctrl):
        table[2 * joint, index] = -np.deg2rad(degrees)
        table[2 * joint + 1, index] = np.deg2rad(degrees)
    turned = ctrl + jnp.asarray(table)[action]
    gripper = jnp.where(
        action == OPEN,
        high[ids.gripper_ctrl],
        jnp.where(action == CLOSE, low[ids.gripper_ctrl], ctrl[ids.gripper_ctrl]),
    )
    return jnp.clip(turned.at[ids.gripper_ctrl].set(gripper), low, high)


def grasped(mj_model: mujoco.MjModel, ids: TaskIds, poses: Poses, ctrl: jax.Array) -> jax.Array:
    """Whether the gripper, commanded shut, holds the cube between its fingers.

    True where a pad of each finger touches the cube and the two touched faces are opposite ones.
    A pure function of the state; the tests hold it against the contact forces.

    Args:
      mj_model: the scene's model.
      ids: the task's ids.
      poses: of the geoms.
      ctrl: `[nu] float32`.

    Returns:
      `[] bool`.
    """
    radius = mj_model.geom_size[ids.pad_geoms, 0].astype(np.float32)
    half = np.float32(ids.cube_half_size)
    offset = poses.geom_xpos[ids.pad_geoms] - poses.geom_xpos[ids.cube_geom]
    rotation = poses.geom_xmat[ids.cube_geom]
    local = jnp.sum(offset[..., :, None] * rotation, axis=-2)
    beyond = jnp.abs(local) - half
    outside = jnp.sqrt(jnp.sum(jnp.square(jnp.maximum(beyond, 0.0)), axis=-1))
    distance = outside + jnp.minimum(jnp.max(beyond, axis=-1), 0.0) - radius
    touching = distance < _TOUCH
    # [finger, pad, face]: which of the six faces a touching pad is on.
    axis = jax.nn.one_hot(jnp.argmax(beyond, axis=-1), 3, dtype=jnp.bool_) & touching[..., None]
    positive = jnp.any(axis & (local > 0), axis=1)
    negative = jnp.any(axis & (local < 0), axis=1)
    opposed = (positive[0] & negative[1]) | (negative[0] & positive[1])
    shut = ctrl[ids.gripper_ctrl] < half
    return shut & jnp.any(opposed)
