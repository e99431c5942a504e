"""Forward kinematics: where the geoms and sites of a scene are, given `qpos`.

For starts of episodes, for MJX, and for frames that are rendered again from the replay; the native
backend has MuJoCo compute the same.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TypeAlias

import flax.struct
import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_arm.varies import Params, Varies, fill

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


def make_kinematics(mj_model: mujoco.MjModel, varies: Varies | None = None) -> Callable[..., Poses]:
    """Makes `poses(qpos)`, MuJoCo's `mj_kinematics` for free, hinge and slide joints.

    Args:
      mj_model: a model without ball joints and mocap bodies.
      varies: what varies by episode; `geom_pos`, `geom_quat`, `body_pos` and `body_quat` are read.

    Returns:
      A pure function from `qpos [nq] float32` and params to `Poses`.

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

    varies = {} if varies is None else varies

    def poses(qpos: jax.Array, params: Params | None = None) -> Poses:
        # Fields that do not vary keep the model's float64 values.
        geom_pos, geom_quat, body_pos, body_quat = (
            fill(mj_model, varies, params, name) if name in varies else getattr(mj_model, name)
            for name in ("geom_pos", "geom_quat", "body_pos", "body_quat")
        )
        position: list[_Vector] = [[0.0, 0.0, 0.0]]
        rotation: list[_Matrix] = [[[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]]
        for body in range(1, mj_model.nbody):
            pos, rot = _body_pose(mj_model, body, qpos, position, rotation, body_pos, body_quat)
            position.append(pos)
            rotation.append(rot)
        geom_xpos = [
            _transform(position[body], rotation[body], _vector(offset))
            for body, offset in zip(mj_model.geom_bodyid, geom_pos, strict=True)
        ]
        geom_xmat = [
            _multiply(rotation[body], _constant_rotation(quat))
            for body, quat in zip(mj_model.geom_bodyid, geom_quat, strict=True)
        ]
        site_xpos = [
            _transform(position[body], rotation[body], _vector(offset))
            for body, offset in zip(mj_model.site_bodyid, mj_model.site_pos, strict=True)
        ]
        return Poses(
            geom_xpos=_stack(geom_xpos).reshape(-1, 3),
            geom_xmat=_stack(geom_xmat).reshape(-1, 3, 3),
            site_xpos=_stack(site_xpos).reshape(-1, 3),
        )

    return poses


def _body_pose(
    model: mujoco.MjModel,
    body: int,
    qpos: jax.Array,
    position: list[_Vector],
    rotation: list[_Matrix],
    body_pos: jax.Array | np.ndarray,
    body_quat: jax.Array | np.ndarray,
) -> tuple[_Vector, _Matrix]:
    parent = model.body_parentid[body]
    first = model.body_jntadr[body]
    joints = range(first, first + model.body_jntnum[body])
    if len(joints) and model.jnt_type[first] == _FREE:
        start = model.jnt_qposadr[first]
        return list(qpos[start : start + 3]), _quat_to_mat(qpos[start + 3 : start + 7])
    pos = _transform(position[parent], rotation[parent], _vector(body_pos[body]))
    rot = _multiply(rotation[parent], _constant_rotation(body_quat[body]))
    for joint in joints:
        address = model.jnt_qposadr[joint]
        value = qpos[address] - float(model.qpos0[address])
        axis, anchor = _vector(model.jnt_axis[joint]), _vector(model.jnt_pos[joint])
        if model.jnt_type[joint] == _SLIDE:
            pos = _transform(pos, rot, [_product(value, x) for x in axis])
        else:
            turned = _multiply(rot, _hinge_rotation(model.jnt_axis[joint], value))
            fixed_point = _transform(pos, rot, anchor)
            pos = _transform(fixed_point, turned, [-x for x in anchor])
            rot = turned
    return pos, rot


# A pose is kept as single numbers, so that under vmap each is a vector over the environments, and
# the constants 0 and 1 of axis-aligned frames cost nothing. On CPU this is 3 (32 environments) to
# 9 times (4,096) as fast as [3, 3] arrays, whose short inner axes do not fill a vector register.
_Scalar: TypeAlias = "jax.Array | float"
_Vector: TypeAlias = "list[_Scalar]"
_Matrix: TypeAlias = "list[_Vector]"


def _product(left: _Scalar, right: _Scalar) -> _Scalar:
    for one, other in ((left, right), (right, left)):
        if isinstance(one, float) and one in (0.0, 1.0):
            return 0.0 if one == 0.0 else other
    return left * right


def _sum(terms: Iterable[_Scalar]) -> _Scalar:
    total: _Scalar = 0.0
    for term in terms:
        if isinstance(term, float) and term == 0.0:
            continue
        total = term if isinstance(total, float) and total == 0.0 else total + term
    return total


def _dot(left: _Vector, right: _Vector) -> _Scalar:
    return _sum(_product(x, y) for x, y in zip(left, right, strict=True))


def _transform(pos: _Vector, rot: _Matrix, offset: _Vector) -> _Vector:
    return [_sum((x, _dot(row, offset))) for x, row in zip(pos, rot, strict=True)]


def _multiply(left: _Matrix, right: _Matrix) -> _Matrix:
    columns = [list(column) for column in zip(*right, strict=True)]
    return [[_dot(row, column) for column in columns] for row in left]


def _hinge_rotation(axis: np.ndarray, angle: jax.Array) -> _Matrix:
    """Rodrigues' formula for a constant unit axis; `angle` in rad."""
    x, y, z = axis
    outer = np.outer(axis, axis)
    cross = np.asarray([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    return [
        [
            _sum((a, _product(cos, b), _product(sin, c)))
            for a, b, c in zip(_vector(u), _vector(v), _vector(w), strict=True)
        ]
        for u, v, w in zip(outer, np.eye(3) - outer, cross, strict=True)
    ]


def _quat_to_mat(quat: jax.Array) -> _Matrix:
    """Rotation matrix of `[4] float32` (w, x, y, z), normalised first."""
    norm = jax.lax.rsqrt(sum(quat[i] * quat[i] for i in range(4)))
    w, x, y, z = (quat[i] * norm for i in range(4))
    return [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]


def _constant_rotation(quat: np.ndarray | jax.Array) -> _Matrix:
    if isinstance(quat, jax.Array):
        return _quat_to_mat(quat)
    mat = np.empty(9)
    mujoco.mju_quat2Mat(mat, quat)
    # Rounded, or the last bits of a converted Euler angle would hide an exact 0 or 1.
    return [_vector(row) for row in mat.reshape(3, 3).round(12)]


def _vector(values: np.ndarray | jax.Array) -> _Vector:
    if isinstance(values, jax.Array):
        return list(values)
    return [float(x) for x in values]


def _stack(values: list[_Vector] | list[_Matrix]) -> jax.Array:
    leaves = [jnp.asarray(x, jnp.float32) for x in jax.tree.leaves(values)]
    return jnp.stack(leaves) if leaves else jnp.zeros((0,), jnp.float32)
