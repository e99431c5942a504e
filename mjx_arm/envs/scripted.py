"""A scripted policy that grasps the cube and lifts it with the actions of the task, by any arm.

It knows the state, not the image: proof that the task can be done, and a source of demonstrations.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_arm.envs.arm import Arm
from mjx_arm.envs.env import Env
from mjx_arm.envs.state import EnvState
from mjx_arm.envs.tasks.lift import Lift, grasped
from mjx_arm.scene import Scene

# Ways and distances of the plan, m.
_HOVER = 0.09
_SLICE = 0.02
_ALIGNED = 0.025
_AT_CUBE = 0.016
_LIFT_MARGIN = 0.03
# A target is reached when no joint can come nearer by a whole step.
_REACHED = 0.51
_MISSED = 0.002
# Out of this many steps, in this many the joints take turns.
_PERIOD = 40
_TURNS = 8

# Inverse kinematics: Gauss-Newton steps, the largest change of a joint in one (rad or m), what a
# unit of direction counts for in metres, and the pull of the joints to home, which decides among
# the solutions of an arm with more than six joints.
_ITERATIONS = 4
_LARGEST = 0.3
_DIRECTION = 0.3
_PULL = 1e-4


def make_scripted_policy(env: Env) -> Callable[[EnvState], jax.Array]:
    """Makes `policy(state) -> action`.

    The gripper is turned down and along the cube's faces above it, lowered, closed, and raised.

    Args:
      env: the environment. Its arm must be able to point the gripper down over the whole rectangle
        of the cube, and its gripper points from the origin of the body of the site `grasp` to that
        site.

    Returns:
      A pure function from a state to `[] int32`; jit- and vmap-able.

    Raises:
      ValueError: the environment has another task than `lift`, or the direction of the gripper
        cannot be found.
    """
    task, arm = env.task, env.arm
    if not isinstance(task, Lift):
        raise ValueError(f"the scripted policy lifts cubes; the task is {env.config.task!r}")
    solve = _make_inverse_kinematics(arm, _make_tool(env.scene, arm))
    steps = np.where(
        arm.slides,
        env.config.millimetres_per_action / 1000.0,
        np.deg2rad(env.config.degrees_per_action),
    ).astype(np.float32)
    shut = arm.ctrl_range[arm.gripper_ctrl, 0]
    top = np.float32(task.config.lift + task.half_size + _LIFT_MARGIN)
    radius = float(np.hypot(*_at_home(env.scene, arm).site_xpos[arm.grasp_site, :2]))

    def policy(state: EnvState) -> jax.Array:
        poses, qpos = state.physics.poses, state.physics.qpos
        gripper = poses.site_xpos[arm.grasp_site]
        cube = poses.geom_xpos[task.cube_geom]
        is_grasped = grasped(task, poses, state.ctrl)
        offset = gripper - cube
        aside = jnp.sqrt(jnp.sum(jnp.square(offset[:2])))
        target = jnp.where(is_grasped, _raised(gripper, radius, top), _above(gripper, cube, aside))
        joints = state.ctrl[arm.ctrl]
        faces = poses.geom_xmat[task.cube_geom]
        error = (solve(target, faces, joints, is_grasped) - joints) / steps
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
        return jnp.where(is_grasped, turn, grip).astype(jnp.int32)

    return policy


def _above(gripper: jax.Array, cube: jax.Array, aside: jax.Array) -> jax.Array:
    """The next point on the way to the cube: over it first, then straight down in slices."""
    lower = jnp.maximum(cube[2], gripper[2] - _SLICE)
    return cube.at[2].set(jnp.where(aside < _ALIGNED, lower, cube[2] + _HOVER))


def _raised(gripper: jax.Array, radius: float, top: np.float32) -> jax.Array:
    """The next point on the way up, which leads to `radius`, where the arm reaches the top."""
    distance = jnp.sqrt(jnp.sum(jnp.square(gripper[:2])))
    inward = jnp.clip(np.float32(radius) - distance, -_SLICE, _SLICE)
    height = jnp.minimum(gripper[2] + 2 * _SLICE, top)
    return jnp.append(gripper[:2] * (1 + inward / distance), height)


def _make_tool(scene: Scene, arm: Arm) -> Callable[[jax.Array], tuple[jax.Array, jax.Array]]:
    """Makes `tool(joints [n]) -> (pose [3, 3], slopes [3, 3, n])`.

    The pose has three rows: the grasp site's position (m), the direction in which the gripper
    points, and the direction from finger to finger. The slopes are its derivatives.
    """
    model = scene.mj_model
    body = int(model.site_bodyid[arm.grasp_site])
    chain = [body]
    while model.body_parentid[chain[0]]:
        chain.insert(0, int(model.body_parentid[chain[0]]))
    number = {int(address): k for k, address in enumerate(arm.qpos)}
    local = np.stack([model.site_pos[arm.grasp_site], *_directions(scene, arm, body)])

    def tool(joints: jax.Array) -> tuple[jax.Array, jax.Array]:
        pos, rot = jnp.zeros(3, jnp.float32), jnp.eye(3, dtype=jnp.float32)
        moved: dict[int, tuple[jax.Array, jax.Array | None]] = {}
        for link in chain:
            pos = pos + _times(rot, model.body_pos[link])
            rot = _times(rot, _rotation(model.body_quat[link]))
            first = model.body_jntadr[link]
            for joint in range(first, first + model.body_jntnum[link]):
                k = number.get(int(model.jnt_qposadr[joint]))
                value = arm.home_qpos[model.jnt_qposadr[joint]] if k is None else joints[k]
                value = value - np.float32(model.qpos0[model.jnt_qposadr[joint]])
                axis, anchor = _times(rot, model.jnt_axis[joint]), model.jnt_pos[joint]
                if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE:
                    pos, centre = pos + value * axis, None
                else:
                    centre = pos + _times(rot, anchor)
                    rot = _times(rot, _hinge_rotation(model.jnt_axis[joint], value))
                    pos = centre - _times(rot, anchor)
                if k is not None:
                    moved[k] = axis, centre
        pose = jnp.sum(rot * local.astype(np.float32)[:, None, :], axis=-1).at[0].add(pos)
        slopes = [_slopes(pose, *moved[k]) for k in range(len(joints))]
        return pose, jnp.stack(slopes, axis=-1)

    return tool


def _directions(scene: Scene, arm: Arm, body: int) -> tuple[np.ndarray, np.ndarray]:
    """Where the gripper points, and from finger to finger: unit vectors in the frame of `body`."""
    model = scene.mj_model
    data = _at_home(scene, arm)
    across = data.xmat[body].reshape(3, 3).T @ data.xaxis[scene.find("joint", "left_finger")]
    along = model.site_pos[arm.grasp_site] - across * (across @ model.site_pos[arm.grasp_site])
    length = np.linalg.norm(along)
    if length < 1e-3:
        raise ValueError(
            f"scene {scene.name!r}: site 'grasp' must be away from the origin of its body, in "
            "the direction in which the gripper points"
        )
    return along / length, across


def _at_home(scene: Scene, arm: Arm) -> mujoco.MjData:
    data = mujoco.MjData(scene.mj_model)
    data.qpos[:] = arm.home_qpos
    mujoco.mj_kinematics(scene.mj_model, data)
    return data


def _slopes(pose: jax.Array, axis: jax.Array, centre: jax.Array | None) -> jax.Array:
    """Derivative of the tool's pose by a slide along `axis`, or by a hinge about it at `centre`."""
    if centre is None:
        return jnp.stack([axis, jnp.zeros_like(axis), jnp.zeros_like(axis)])
    return jnp.cross(axis, pose.at[0].add(-centre))


def _times(rot: jax.Array, other: np.ndarray | jax.Array) -> jax.Array:
    """`rot @ other` for a vector or a matrix, as sums that XLA fuses."""
    if isinstance(other, np.ndarray) and np.array_equal(other, np.eye(3)):
        return rot
    right = jnp.asarray(other, jnp.float32)
    if right.ndim == 1:
        return jnp.sum(rot * right, axis=-1)
    return jnp.sum(rot[:, :, None] * right, axis=1)


def _rotation(quat: np.ndarray) -> np.ndarray:
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, quat)
    return matrix.reshape(3, 3)


def _hinge_rotation(axis: np.ndarray, angle: jax.Array) -> jax.Array:
    """Rodrigues' formula."""
    x, y, z = axis
    cross = np.asarray([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    eye, sine, versine = np.eye(3, dtype=np.float32), jnp.sin(angle), 1 - jnp.cos(angle)
    return eye + sine * cross.astype(np.float32) + versine * (cross @ cross).astype(np.float32)


def _make_inverse_kinematics(
    arm: Arm, tool: Callable[[jax.Array], tuple[jax.Array, jax.Array]]
) -> Callable[[jax.Array, jax.Array, jax.Array, jax.Array], jax.Array]:
    """Makes `solve(target [3], faces [3, 3], joints [n], is_grasped []) -> joints [n]`.

    Damped least squares: the grasp site at the target, the gripper down, the fingers along the
    faces of the cube, or where they are if it is grasped, and the joints near home.
    """
    home = jnp.asarray(arm.home_qpos[arm.qpos])
    low, high = arm.ctrl_range[arm.ctrl].T
    weights = jnp.asarray([1.0, _DIRECTION, _DIRECTION], jnp.float32)[:, None]
    pull = np.float32(_PULL)

    def solve(
        target: jax.Array, faces: jax.Array, joints: jax.Array, is_grasped: jax.Array
    ) -> jax.Array:
        down = jnp.asarray([0.0, 0.0, -1.0], jnp.float32)
        across = _finger_direction(tool(joints)[0][2], faces, is_grasped)
        wanted = jnp.stack([target, down, across])

        def improve(_: int, joints: jax.Array) -> jax.Array:
            pose, slopes = tool(joints)
            error = (weights * (wanted - pose)).reshape(-1, 1)
            slopes = (weights[..., None] * slopes).reshape(len(error), -1)
            normal = jnp.sum(slopes[:, :, None] * slopes[:, None, :], axis=0)
            downhill = jnp.sum(slopes * error, axis=0) + pull * (home - joints)
            change = _solve_positive(normal + pull * np.eye(len(home), dtype=np.float32), downhill)
            return jnp.clip(joints + jnp.clip(change, -_LARGEST, _LARGEST), low, high)

        return jax.lax.fori_loop(0, _ITERATIONS, improve, joints)

    return solve


def _finger_direction(across: jax.Array, faces: jax.Array, is_grasped: jax.Array) -> jax.Array:
    """The horizontal direction nearest to `across` that is normal to a face of the cube."""
    heading = jnp.arctan2(across[1], across[0])
    # The edge of the cube that lies flattest; a cube can be on any of its faces.
    edge = faces[:, jnp.argmin(jnp.abs(faces[2]))]
    quarter = np.float32(np.pi / 2)
    turn = jnp.mod(jnp.arctan2(edge[1], edge[0]) - heading + quarter / 2, quarter) - quarter / 2
    heading = heading + jnp.where(is_grasped, jnp.zeros_like(turn), turn)
    return jnp.stack([jnp.cos(heading), jnp.sin(heading), jnp.zeros_like(heading)])


def _solve_positive(matrix: jax.Array, vector: jax.Array) -> jax.Array:
    """Solves a small positive definite system by elimination, which vmap turns into plain loops."""
    rows = jnp.concatenate([matrix, vector[:, None]], axis=1)
    for k in range(len(vector)):
        pivot = rows[k] / rows[k, k]
        rows = (rows - rows[:, k : k + 1] * pivot).at[k].set(pivot)
    return rows[:, -1]
