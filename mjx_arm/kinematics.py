"""Forward kinematics: world poses of geoms, sites and cameras, given `qpos`.

It serves the starts of episodes, MJX, cameras on moving bodies, and the frames that are rendered
again from the replay. The native backend takes the same poses from MuJoCo.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Protocol, TypeAlias

import flax.struct
import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_arm.varies import Params, Varies, check_params, check_varies

_FREE = int(mujoco.mjtJoint.mjJNT_FREE)
_HINGE = int(mujoco.mjtJoint.mjJNT_HINGE)
_SLIDE = int(mujoco.mjtJoint.mjJNT_SLIDE)

# Below this norm MuJoCo takes a quaternion for zero.
_MIN_NORM = 1e-15

# What poses depend on besides the fields that may vary.
_CONSTANT_FIELDS = ("qpos0", "jnt_pos", "jnt_axis", "site_pos")


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


class Kinematics(Protocol):
    """World poses at `qpos [nq] float32`; see `make_kinematics`."""

    def __call__(self, qpos: jax.Array, params: Params | None = None) -> Poses:
        """Computes the poses of one state."""
        ...


class CameraPose(Protocol):
    """World pose of a camera at `qpos [nq] float32`; see `make_camera_pose`."""

    def __call__(
        self, qpos: jax.Array, params: Params | None = None
    ) -> tuple[jax.Array, jax.Array]:
        """Computes position `[3]` and axes `[3, 3]` at one state."""
        ...


def make_kinematics(
    mj_model: mujoco.MjModel,
    varies: Varies | None = None,
    geoms: Sequence[int] | None = None,
) -> Kinematics:
    """Makes `kinematics(qpos, params={})`, MuJoCo's `mj_kinematics` in pure JAX.

    A quaternion need not have unit length; a zero quaternion is the identity, as in MuJoCo.

    Args:
      mj_model: a model with free, hinge and slide joints, and without mocap bodies.
      varies: which rows of the model vary by episode. Of these the function reads `geom_pos`,
        `geom_quat`, `body_pos` and `body_quat` from its `params`.
      geoms: ids of the geoms whose poses are wanted, in this order, and no sites; None for all
        geoms and sites.

    Returns:
      A pure function from `qpos [nq] float32` and `Params` to `Poses`.

    Raises:
      ValueError: the model has a joint or body that is not supported, or `varies` has an unknown
        row or a field of joints or sites that cannot vary. The returned function raises it
        for `params` that do not fit `varies`.
    """
    _check_bodies(mj_model, range(mj_model.nbody))
    _check_varies(mj_model, varies)
    ids = range(mj_model.ngeom) if geoms is None else [int(geom) for geom in geoms]
    site_ids = range(mj_model.nsite) if geoms is None else range(0)

    def kinematics(qpos: jax.Array, params: Params | None = None) -> Poses:
        check_params(mj_model, varies, params)
        read = _make_read(mj_model, varies, params)
        frames = _body_frames(mj_model, range(mj_model.nbody), qpos, read)
        of_geom = {i: frames[mj_model.geom_bodyid[i]] for i in ids}
        of_site = {i: frames[mj_model.site_bodyid[i]] for i in site_ids}
        geom_xpos = [_transform(*frame, read("geom_pos", i)) for i, frame in of_geom.items()]
        geom_xmat = [
            _multiply(rotation, _rotation(read("geom_quat", i)))
            for i, (_, rotation) in of_geom.items()
        ]
        site_xpos = [_transform(*frame, read("site_pos", i)) for i, frame in of_site.items()]
        return Poses(
            geom_xpos=_stack(geom_xpos).reshape(-1, 3),
            geom_xmat=_stack(geom_xmat).reshape(-1, 3, 3),
            site_xpos=_stack(site_xpos).reshape(-1, 3),
        )

    # Traced once for each shape, however many programs call it.
    traced_once: Kinematics = jax.jit(kinematics)
    return traced_once


def make_camera_pose(
    mj_model: mujoco.MjModel, camera: str, varies: Varies | None = None
) -> CameraPose:
    """Makes `camera_pose(qpos, params={})`, the world pose of a camera on any body.

    The renderer of a camera on a moving body takes the result as its `camera_pose`.

    Args:
      mj_model: the model. From the world to the camera's body it has free, hinge and slide joints
        only, and no mocap body.
      camera: name of a camera of mode `fixed`: one that moves with its body.
      varies: which rows of the model vary by episode. Of these the function reads `cam_pos`,
        `cam_quat`, `body_pos` and `body_quat` from its `params`.

    Returns:
      A pure function from `qpos [nq] float32` and `Params` to the position, `[3] float32`, m, and
      the axes in columns, `[3, 3] float32`: x right, y up, looking along -z.

    Raises:
      ValueError: the camera is unknown or of another mode, or as `make_kinematics`.
    """
    camera_id = find_camera(mj_model, camera)
    chain = _chain(mj_model, mj_model.cam_bodyid[camera_id])
    _check_bodies(mj_model, chain)
    _check_varies(mj_model, varies)

    def camera_pose(qpos: jax.Array, params: Params | None = None) -> tuple[jax.Array, jax.Array]:
        check_params(mj_model, varies, params)
        read = _make_read(mj_model, varies, params)
        frame = _body_frames(mj_model, chain, qpos, read)[chain[-1]]
        pos = _transform(*frame, read("cam_pos", camera_id))
        mat = _multiply(frame[1], _rotation(read("cam_quat", camera_id)))
        return _stack([pos]), _stack(mat).reshape(3, 3)

    return camera_pose


def find_camera(mj_model: mujoco.MjModel, camera: str) -> int:
    """Returns the id of a camera that is fixed to a body.

    Raises:
      ValueError: the camera is unknown, or its mode is not `fixed`.
    """
    names = [mj_model.camera(i).name for i in range(mj_model.ncam)]
    if camera not in names:
        raise ValueError(f"unknown camera {camera!r}: the scene has {names}")
    camera_id = names.index(camera)
    mode = mujoco.mjtCamLight(int(mj_model.cam_mode[camera_id]))
    if mode != mujoco.mjtCamLight.mjCAMLIGHT_FIXED:
        name = mode.name.removeprefix("mjCAMLIGHT_").lower()
        raise ValueError(f"camera {camera!r} has the mode {name!r}; supported is mode='fixed' only")
    return camera_id


def _check_bodies(mj_model: mujoco.MjModel, bodies: Sequence[int]) -> None:
    for joint in np.flatnonzero(np.isin(mj_model.jnt_bodyid, bodies)).tolist():
        if mj_model.jnt_type[joint] not in (_FREE, _HINGE, _SLIDE):
            raise ValueError(
                f"joint {mj_model.joint(joint).name!r} is a ball joint; "
                "supported are free, hinge and slide joints"
            )
    if np.any(mj_model.body_mocapid[list(bodies)] >= 0):
        raise ValueError("the scene has mocap bodies, which are not supported")


def _check_varies(mj_model: mujoco.MjModel, varies: Varies | None) -> None:
    check_varies(mj_model, varies)
    for field in varies or {}:
        if field in _CONSTANT_FIELDS:
            raise ValueError(
                f"{field!r} cannot vary by episode; poses may vary by geom_pos, geom_quat, "
                "body_pos and body_quat"
            )


def _chain(model: mujoco.MjModel, body: int) -> list[int]:
    """The world and all bodies from there to `body`."""
    chain = [int(body)]
    while chain[0]:
        chain.insert(0, int(model.body_parentid[chain[0]]))
    return chain


def _make_read(model: mujoco.MjModel, varies: Varies | None, params: Params | None) -> _Read:
    """Makes `read(field, row)`, the numbers of a row: traced where it varies, else constants."""
    place = {field: {row: k for k, row in enumerate(ids)} for field, ids in (varies or {}).items()}

    def read(field: str, row: int) -> _Vector:
        k = place.get(field, {}).get(row)
        if k is None:
            return _vector(getattr(model, field)[row])
        return list(jnp.asarray((params or {})[field][k], jnp.float32))

    return read


def _body_frames(
    model: mujoco.MjModel, bodies: Sequence[int], qpos: jax.Array, read: _Read
) -> dict[int, _Frame]:
    """Position and rotation of each of `bodies`, which lists parents before their children."""
    frames: dict[int, _Frame] = {0: ([0.0, 0.0, 0.0], _constant_rotation([1.0, 0.0, 0.0, 0.0]))}
    tilted: set[int] = set()
    for body in bodies:
        if body == 0:
            continue
        frame = _body_frame(model, body, qpos, read, frames)
        if int(model.body_parentid[body]) in tilted or _is_tilted(model, body, read):
            tilted.add(body)
            frame = _fence(frame)
        frames[body] = frame
    return frames


def _body_frame(
    model: mujoco.MjModel, body: int, qpos: jax.Array, read: _Read, frames: dict[int, _Frame]
) -> _Frame:
    first = model.body_jntadr[body]
    joints = range(first, first + model.body_jntnum[body])
    if len(joints) and model.jnt_type[first] == _FREE:
        start = model.jnt_qposadr[first]
        return list(qpos[start : start + 3]), _quat_to_mat(qpos[start + 3 : start + 7])
    parent = frames[int(model.body_parentid[body])]
    pos = _transform(*parent, read("body_pos", body))
    rot = _multiply(parent[1], _rotation(read("body_quat", body)))
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


def _is_tilted(model: mujoco.MjModel, body: int, read: _Read) -> bool:
    """Whether the body's rotation in its parent is more than a turn about an axis of the frame."""
    first = model.body_jntadr[body]
    joints = [*range(first, first + model.body_jntnum[body])]
    if any(model.jnt_type[joint] == _FREE for joint in joints):
        return False
    numbers = [x for row in _rotation(read("body_quat", body)) for x in row]
    for joint in joints:
        if model.jnt_type[joint] == _HINGE:
            numbers += _vector(model.jnt_axis[joint])
    return any(not isinstance(x, float) or abs(x) not in (0.0, 1.0) for x in numbers)


def _fence(frame: _Frame) -> _Frame:
    """Returns the frame unchanged, but computed before anything that reads it.

    XLA on CPU fuses a body's pose into every geom and body that hangs on it, and so computes the
    whole chain again for each. Compiled code then grows with the square of the chain's length,
    and where frames are tilted no 0 or 1 keeps it small. An array that is rounded to the precision
    that it has is not fused any further; `optimization_barrier` does not prevent it.
    """
    pos, rot = frame
    if all(isinstance(x, float) for x in jax.tree.leaves(frame)):
        return frame
    numbers = list(jax.lax.reduce_precision(_stack([pos, *rot]), 8, 23))
    return numbers[:3], [numbers[3:6], numbers[6:9], numbers[9:12]]


# A pose is kept as single numbers, so that under vmap each is a vector over the environments, and
# the constants 0 and 1 of axis-aligned frames cost nothing. On CPU this is 3 (32 environments) to
# 9 times (4,096) as fast as [3, 3] arrays, whose short inner axes do not fill a vector register.
_Scalar: TypeAlias = "jax.Array | float"
_Vector: TypeAlias = "list[_Scalar]"
_Matrix: TypeAlias = "list[_Vector]"
_Frame: TypeAlias = "tuple[_Vector, _Matrix]"
_Read: TypeAlias = "Callable[[str, int], _Vector]"


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


def _rotation(quat: _Vector) -> _Matrix:
    constants = [x for x in quat if isinstance(x, float)]
    return _constant_rotation(constants) if len(constants) == 4 else _quat_to_mat(quat)


def _quat_to_mat(quat: jax.Array | _Vector) -> _Matrix:
    """Rotation matrix of (w, x, y, z), normalised first; zero is the identity."""
    norm2 = jnp.asarray(sum(quat[i] * quat[i] for i in range(4)))
    zero = norm2 < _MIN_NORM**2
    norm = jax.lax.rsqrt(jnp.where(zero, jnp.ones_like(norm2), norm2))
    w, x, y, z = (quat[i] * norm for i in range(4))
    w = jnp.where(zero, jnp.ones_like(norm2), w)
    return [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]


def _constant_rotation(quat: Sequence[float]) -> _Matrix:
    unit, mat = np.array(quat), np.empty(9)
    mujoco.mju_normalize4(unit)
    mujoco.mju_quat2Mat(mat, unit)
    # Rounded, or the last bits of a converted Euler angle would hide an exact 0 or 1.
    return [_vector(row) for row in mat.reshape(3, 3).round(12)]


def _vector(values: np.ndarray) -> _Vector:
    return [float(x) for x in values]


def _stack(values: list[_Vector] | list[_Matrix]) -> jax.Array:
    leaves = [jnp.asarray(x, jnp.float32) for x in jax.tree.leaves(values)]
    return jnp.stack(leaves) if leaves else jnp.zeros((0,), jnp.float32)
