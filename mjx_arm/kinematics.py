"""Forward kinematics: where the geoms and sites of a scene are, given `qpos`.

Poses are computed here from the state that physics returns, for both backends and for frames that
are rendered again from the replay, so that an image can never lag behind its state by a substep.
"""

from __future__ import annotations

from collections.abc import Callable

import flax.struct
import jax
import jax.numpy as jnp
import mujoco
import numpy as np

_FREE = int(mujoco.mjtJoint.mjJNT_FREE)
_HINGE = int(mujoco.mjtJoint.mjJNT_HINGE)
_SLIDE = int(mujoco.mjtJoint.mjJNT_SLIDE)


@flax.struct.dataclass
class Poses:
    """World poses at one state.

    Attributes:
      geom_xpos: `[ngeom, 3] float32`, m.
      geom_xmat: `[ngeom, 3, 3] float32`.
      site_xpos: `[nsite, 3] float32`, m.
    """

    geom_xpos: jax.Array
    geom_xmat: jax.Array
    site_xpos: jax.Array


def make_kinematics(mj_model: mujoco.MjModel) -> Callable[[jax.Array], Poses]:
    """Makes `poses(qpos)`, MuJoCo's `mj_kinematics` for free, hinge and slide joints.

    Args:
      mj_model: a model without ball joints and mocap bodies.

    Returns:
      A pure function from `qpos [nq] float32` to `Poses`.

    Raises:
      ValueError: the model has a joint or body that is not supported.
    """
    for joint in range(mj_model.njnt):
        if mj_model.jnt_type[joint] not in (_FREE, _HINGE, _SLIDE):
            raise ValueError(
                f"joint {mj_model.joint(joint).name!r} is a ball joint; "
                "supported are free, hinge and slide joints"
            )
    if mj_model.nmocap:
        raise ValueError("the scene has mocap bodies, which are not supported")

    def poses(qpos: jax.Array) -> Poses:
        position = [jnp.zeros(3, jnp.float32)]
        rotation = [jnp.eye(3, dtype=jnp.float32)]
        for body in range(1, mj_model.nbody):
            pos, rot = _body_pose(mj_model, body, qpos, position, rotation)
            position.append(pos)
            rotation.append(rot)
        xpos, xmat = jnp.stack(position), jnp.stack(rotation)
        geom_body, site_body = mj_model.geom_bodyid, mj_model.site_bodyid
        return Poses(
            geom_xpos=xpos[geom_body] + _rotate(xmat[geom_body], _f32(mj_model.geom_pos)),
            geom_xmat=_multiply(xmat[geom_body], _constant_rotations(mj_model.geom_quat)),
            site_xpos=xpos[site_body] + _rotate(xmat[site_body], _f32(mj_model.site_pos)),
        )

    return poses


def _body_pose(
    model: mujoco.MjModel,
    body: int,
    qpos: jax.Array,
    position: list[jax.Array],
    rotation: list[jax.Array],
) -> tuple[jax.Array, jax.Array]:
    parent = model.body_parentid[body]
    first = model.body_jntadr[body]
    joints = range(first, first + model.body_jntnum[body])
    if len(joints) and model.jnt_type[first] == _FREE:
        start = model.jnt_qposadr[first]
        return qpos[start : start + 3], quat_to_mat(qpos[start + 3 : start + 7])
    pos = position[parent] + _rotate(rotation[parent], _f32(model.body_pos[body]))
    rot = _multiply(rotation[parent], _constant_rotations(model.body_quat[body]))
    for joint in joints:
        value = qpos[model.jnt_qposadr[joint]] - float(model.qpos0[model.jnt_qposadr[joint]])
        axis, anchor = _f32(model.jnt_axis[joint]), _f32(model.jnt_pos[joint])
        if model.jnt_type[joint] == _SLIDE:
            pos = pos + _rotate(rot, axis) * value
        else:
            turned = _multiply(rot, axis_angle_to_mat(axis, value))
            pos = pos + _rotate(rot, anchor) - _rotate(turned, anchor)
            rot = turned
    return pos, rot


def axis_angle_to_mat(axis: np.ndarray, angle: jax.Array) -> jax.Array:
    """Rotation by Rodrigues' formula.

    Args:
      axis: `[3] float32`, a constant unit vector.
      angle: `[] float32`, rad.

    Returns:
      `[3, 3] float32`.
    """
    x, y, z = axis
    cross = np.asarray([[0, -z, y], [z, 0, -x], [-y, x, 0]], np.float32)
    outer = np.outer(axis, axis).astype(np.float32)
    eye = np.eye(3, dtype=np.float32)
    return jnp.cos(angle) * (eye - outer) + jnp.sin(angle) * cross + outer


def quat_to_mat(quat: jax.Array) -> jax.Array:
    """Rotation matrix of a quaternion `[4] float32` (w, x, y, z), normalised first: `[3, 3]`."""
    w, x, y, z = quat * jax.lax.rsqrt(jnp.sum(quat * quat))
    return jnp.stack(
        [
            jnp.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]),
            jnp.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]),
            jnp.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]),
        ]
    )


def _constant_rotations(quats: np.ndarray) -> np.ndarray:
    mats = np.empty((*quats.shape[:-1], 9))
    for index in np.ndindex(quats.shape[:-1]):
        mujoco.mju_quat2Mat(mats[index], quats[index])
    return _f32(mats.reshape(*quats.shape[:-1], 3, 3))


def _f32(array: np.ndarray) -> np.ndarray:
    return np.asarray(array, np.float32)


def _multiply(left: jax.Array, right: jax.Array | np.ndarray) -> jax.Array:
    # Sums of products instead of a dot: exact in float32 on every device, and fused on CPU.
    return jnp.sum(left[..., :, :, None] * right[..., None, :, :], axis=-2)


def _rotate(mat: jax.Array, vector: jax.Array | np.ndarray) -> jax.Array:
    return jnp.sum(mat * vector[..., None, :], axis=-1)
