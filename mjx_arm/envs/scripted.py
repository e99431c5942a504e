"""A scripted policy that grasps the cube and lifts it with the 14 actions of the task.

It knows the state, not the image: proof that the task can be done, and a source of demonstrations.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from mjx_arm.envs.env import Env
from mjx_arm.envs.state import EnvState
from mjx_arm.envs.tasks.lift import Lift, grasped

# Ways and distances of the plan, m.
_HOVER = 0.09
_SLICE = 0.02
_ALIGNED = 0.025
_AT_CUBE = 0.016
_LIFT_RADIUS = 0.33
_LIFT_MARGIN = 0.03
# A target is reached when no joint can come nearer by a whole step.
_REACHED = 0.51
_MISSED = 0.002
# Out of so many steps, in so many the joints take turns.
_PERIOD = 40
_TURNS = 8


def make_scripted_policy(env: Env) -> Callable[[EnvState], jax.Array]:
    """Makes `policy(state) -> action`, for an arm whose shoulder, elbow and wrist share a plane.

    The gripper is turned down and along the cube's faces above it, lowered, shut, and raised.

    Args:
      env: the environment; lengths are read from its scene.

    Returns:
      A pure function from a state to `[] int32`; jit- and vmap-able.

    Raises:
      ValueError: the environment has another task than `lift`.
    """
    task, arm = env.task, env.arm
    if not isinstance(task, Lift):
        raise ValueError(f"the scripted policy lifts cubes; the task is {env.config.task!r}")
    solve = _make_inverse_kinematics(env)
    step = np.float32(np.deg2rad(env.config.degrees_per_action))
    shut = arm.ctrl_range[arm.gripper_ctrl, 0]
    top = np.float32(task.config.lift + task.half_size + _LIFT_MARGIN)

    def policy(state: EnvState) -> jax.Array:
        poses, qpos = state.physics.poses, state.physics.qpos
        gripper = poses.site_xpos[arm.grasp_site]
        cube = poses.geom_xpos[task.cube_geom]
        held = grasped(task, poses, state.ctrl)
        offset = gripper - cube
        aside = jnp.sqrt(jnp.sum(jnp.square(offset[:2])))
        target = jnp.where(held, _raised(gripper, top), _above(gripper, cube, aside))
        joints = state.ctrl[arm.ctrl]
        yaw = jnp.arctan2(
            poses.geom_xmat[task.cube_geom, 1, 0], poses.geom_xmat[task.cube_geom, 0, 0]
        )
        error = (solve(target, yaw, joints, held) - joints) / step
        away = jnp.abs(error) > _REACHED
        # The furthest joint goes first; now and then they take turns, or two could undo each other
        # for ever.
        turns = jnp.mod(jnp.arange(len(error)) - state.step, len(error))
        in_turn = jnp.argmin(jnp.where(away, turns, len(error)))
        furthest = jnp.argmax(jnp.abs(error))
        joint = jnp.where(state.step % _PERIOD < _TURNS, in_turn, furthest).astype(jnp.int32)
        turn = 2 * joint + (error[joint] > 0).astype(jnp.int32)
        reached = ~jnp.any(away)
        at_cube = (aside < _ALIGNED) & (offset[2] < _AT_CUBE)
        closing = state.ctrl[arm.gripper_ctrl] < task.half_size
        missed = closing & (jnp.max(qpos[arm.finger_qpos]) < shut + _MISSED)
        close = (at_cube & reached) | (closing & ~missed)
        grip = jnp.where(missed, arm.open_action, jnp.where(close, arm.close_action, turn))
        return jnp.where(held, turn, grip).astype(jnp.int32)

    return policy


def _above(gripper: jax.Array, cube: jax.Array, aside: jax.Array) -> jax.Array:
    """The next point on the way to the cube: over it first, then straight down in slices."""
    lower = jnp.maximum(cube[2], gripper[2] - _SLICE)
    return cube.at[2].set(jnp.where(aside < _ALIGNED, lower, cube[2] + _HOVER))


def _raised(gripper: jax.Array, top: np.float32) -> jax.Array:
    """The next point on the way up, which leads to a radius where the arm reaches the top."""
    radius = jnp.sqrt(jnp.sum(jnp.square(gripper[:2])))
    inward = jnp.clip(np.float32(_LIFT_RADIUS) - radius, -_SLICE, _SLICE)
    height = jnp.minimum(gripper[2] + 2 * _SLICE, top)
    return jnp.append(gripper[:2] * (1 + inward / radius), height)


def _make_inverse_kinematics(
    env: Env,
) -> Callable[[jax.Array, jax.Array, jax.Array, jax.Array], jax.Array]:
    """Closed form for the gripper pointing straight down."""
    model = env.scene.mj_model
    joints = [model.actuator_trnid[i, 0] for i in env.arm.ctrl]
    bodies = model.jnt_bodyid[joints]
    pos = model.body_pos
    shoulder = pos[bodies[0], 2] + pos[bodies[1], 2]
    upper = pos[bodies[2]]
    upper_length = float(np.hypot(upper[0], upper[2]))
    upper_tilt = float(np.arctan2(upper[0], upper[2]))
    forearm = float(pos[bodies[3], 0] + pos[bodies[4], 0])
    tool = pos[bodies[5], 0] + model.site_pos[env.arm.grasp_site, 0]

    def solve(target: jax.Array, yaw: jax.Array, joints: jax.Array, held: jax.Array) -> jax.Array:
        radius = jnp.sqrt(jnp.sum(jnp.square(target[:2])))
        height = target[2] + np.float32(tool - shoulder)
        reach = jnp.sqrt(radius * radius + height * height)
        cos_shoulder = (reach**2 + upper_length**2 - forearm**2) / (2 * upper_length * reach)
        cos_elbow = (upper_length**2 + forearm**2 - reach**2) / (2 * upper_length * forearm)
        upper_angle = jnp.arctan2(radius, height) - jnp.arccos(jnp.clip(cos_shoulder, -1, 1))
        forearm_angle = upper_angle + np.pi - jnp.arccos(jnp.clip(cos_elbow, -1, 1))
        waist = jnp.arctan2(target[1], target[0])
        quarter = np.float32(np.pi / 2)
        turn = jnp.mod(waist - yaw + quarter / 2, quarter) - quarter / 2
        return jnp.stack(
            [
                waist,
                upper_angle - upper_tilt,
                forearm_angle - np.pi / 2 - (upper_angle - upper_tilt),
                jnp.zeros_like(waist),
                np.pi - forearm_angle,
                jnp.where(held, joints[5], turn),
            ]
        )

    return solve
