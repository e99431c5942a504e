"""Clearance of an arm from itself, from what does not move, and from given obstacles.

MuJoCo's contacts keep the arm's fingers off the cube and the table. Contacts between links would
slow MJX down, and stiff servos press through them; so a command to a pose that a real arm could
not take is blocked before it is given.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_arm.digest import model_digest
from mjx_arm.kinematics import Poses

# A box or cylinder is a smaller one that is swept by a sphere of at most this radius, m: pairs of
# them have a signed distance down to minus the sum of their radii. It cuts corners by 0.73 times
# as much.
_ROUNDING = 0.003
# The default margin covers the cut corners, the servos' sag and what they lag behind a command.
MARGIN = 0.005
# Alternating projections; the error they leave is in tests/envs/test_collision.py.
_PROJECTIONS = 2
# Random poses that say which pairs can meet, and how near one must come to count, m.
_REACH_POSES = 2000
_REACH_SLACK = 0.01
# Rounding of float32 poses must not block a motion that keeps a distance, m.
_SAME = 5e-6

_PLANE, _SPHERE, _CAPSULE, _BOX, _CYLINDER = (
    int(kind)
    for kind in (
        mujoco.mjtGeom.mjGEOM_PLANE,
        mujoco.mjtGeom.mjGEOM_SPHERE,
        mujoco.mjtGeom.mjGEOM_CAPSULE,
        mujoco.mjtGeom.mjGEOM_BOX,
        mujoco.mjtGeom.mjGEOM_CYLINDER,
    )
)
_pairs_found: dict[tuple[Any, ...], list[tuple[int, int]]] = {}
_SOLID = (_PLANE, _SPHERE, _CAPSULE, _BOX, _CYLINDER)
# MuJoCo shows groups 0 to 2 by default; higher ones hold guards and pads around the same links.
_FIRST_HIDDEN_GROUP = 3
# Links whose joints have meeting axes may overlap by design: those at most this many joints apart.
_MAY_OVERLAP = 2


_Vector: TypeAlias = "jax.Array | np.ndarray | list[jax.Array]"


@dataclasses.dataclass(frozen=True)
class Obstacle:
    """A moving thing that the arm keeps away from, taken for a sphere.

    Attributes:
      geom: id of the geom at whose centre it is.
      radius: m.
    """

    geom: int
    radius: float


@dataclasses.dataclass(frozen=True, eq=False)
class Collision:
    """Pure functions over the poses of one environment; jit- and vmap-able, also nested.

    Attributes:
      pairs: `[P, 2] int`, geom ids whose clearance is computed; the second is always the arm's.
      margin: least clearance of a free pose, m.
      clearances: `(poses) -> [P] float32`, distance of each pair, negative where it overlaps, m.
        Exact for planes. Between other shapes up to 2.2 mm too large at each corner of a box, and
        no less than minus the sum of the radii that `_core` gives.
      geoms: `[G] int`, the geoms that occur in the pairs, by rising id.
      clearances_of_geoms: the same function of poses of those geoms alone, which cost less.
    """

    pairs: np.ndarray
    margin: float
    clearances: Callable[[Poses], jax.Array]
    geoms: np.ndarray
    clearances_of_geoms: Callable[[Poses], jax.Array]

    def is_free(self, poses: Poses) -> jax.Array:
        """Whether all pairs are at least `margin` apart: `[] bool`."""
        return jnp.all(self.clearances(poses) >= np.float32(self.margin))

    def is_blocked(
        self,
        before: Any,
        commanded: Poses,
        poses_of: Callable[[Any], Poses] = lambda poses: poses,
    ) -> jax.Array:
        """Whether a command must not be given: `[] bool`.

        True where it brings a pair closer than `margin`, and closer than the last command does. So
        an arm that is already too near, or inside, can always move out. The poses that the arm is
        in do not count: its servos sag and lag, so that it is often nearer than any command.

        Args:
          before: the argument of `poses_of` for the last command; without `poses_of`, the poses.
          commanded: poses of `geoms` alone, with the arm's joints where the command would have
            them.
          poses_of: returns the poses of `geoms` alone at the last command. Its result is only
            computed where something is near.
        """

        @_called_once
        def blocked(before: Any, commanded: Poses) -> jax.Array:
            after = jax.vmap(self.clearances_of_geoms)(commanded)
            near = after < np.float32(self.margin)

            def closer() -> jax.Array:
                last = jax.vmap(self.clearances_of_geoms)(jax.vmap(poses_of)(before))
                return near & (after < last - np.float32(_SAME))

            # In most steps no arm of the batch is near anything.
            return jnp.any(jax.lax.cond(jnp.any(near), closer, lambda: near), axis=-1)

        found: jax.Array = blocked(before, commanded)
        return found


def _called_once(function: Callable[..., jax.Array]) -> Callable[..., jax.Array]:
    """A function of batches as one of single arguments, called under vmap once with all rows."""

    @jax.custom_batching.custom_vmap
    def many(*arguments: Any) -> jax.Array:
        return function(*arguments)

    @many.def_vmap
    def batch(size: int, is_batched: list[Any], *arguments: Any) -> tuple[jax.Array, bool]:
        repeated = jax.tree.map(
            lambda x, has_axis: x if has_axis else jnp.broadcast_to(x, (size, *x.shape)),
            arguments,
            tuple(is_batched),
        )
        found = many(*jax.tree.map(lambda x: x.reshape(size * x.shape[1], *x.shape[2:]), repeated))
        return found.reshape(size, -1, *found.shape[1:]), True

    def single(*arguments: Any) -> jax.Array:
        found: jax.Array = many(*jax.tree.map(lambda x: x[None], arguments))
        return found[0]

    return single


def make_self_collision(
    mj_model: mujoco.MjModel,
    *,
    obstacles: Sequence[Obstacle] = (),
    ignored: Sequence[int] = (),
    margin: float = MARGIN,
    home: np.ndarray | None = None,
) -> Collision:
    """Finds the pairs of geoms of an arm that must stay apart.

    The arm is every geom that moves on joints but not freely. Only geoms of groups 0 to 2 count,
    the others being guards around them. A pair is an arm's geom with another of its geoms, with one
    that does not move, or with an obstacle. Left out are geoms of the same rigid part, of
    neighbours in the chain, pairs at most two joints apart that are too near at `home`, and pairs
    that come nowhere near each other within the joints' ranges.

    Args:
      mj_model: an arm of planes, spheres, capsules, boxes and cylinders.
      obstacles: what else to keep away from.
      ignored: ids of geoms that the arm may pass through, such as the mark of a place.
      margin: least clearance of a free pose, m.
      home: `[nq]`, a pose that is free by design; by default the first keyframe, or `qpos0`.

    Returns:
      The functions.

    Raises:
      ValueError: a geom of the arm is of another type, or two geoms that are further apart in the
        chain are too near at `home`.
    """
    pairs = _arm_pairs(mj_model, ignored, margin, home)
    arm = _arm_geoms(mj_model)
    pairs.sort(key=lambda pair: mj_model.geom_type[pair[0]] != _PLANE)
    cores = [[_core(mj_model, geom) for geom in pair] for pair in pairs]
    for obstacle, geom in itertools.product(obstacles, arm):
        pairs.append((obstacle.geom, geom))
        cores.append([[0.0, 0.0, 0.0, 0.0, obstacle.radius], _core(mj_model, geom)])
    ids = np.asarray(pairs, int).reshape(-1, 2)
    planes = int((mj_model.geom_type[ids[:, 0]] == _PLANE).sum())
    sizes = np.asarray(cores, np.float32).reshape(-1, 2, 5)
    used = np.unique(ids)
    of_all, of_used = (_make_clearances(ids, sizes, planes, take) for take in (used, None))
    return Collision(ids, margin, of_all, used, of_used)


def _arm_pairs(
    mj_model: mujoco.MjModel, ignored: Sequence[int], margin: float, home: np.ndarray | None
) -> list[tuple[int, int]]:
    """Pairs of the arm's geoms with each other and with still ones; see `make_self_collision`.

    They are kept by the contents of the model, because thousands of poses are tried to find them.
    """
    at = None if home is None else np.asarray(home).tobytes()
    key = (model_digest(mj_model), tuple(ignored), margin, at)
    if key not in _pairs_found:
        _pairs_found[key] = _find_pairs(mj_model, ignored, margin, home)
    return list(_pairs_found[key])


def _find_pairs(
    mj_model: mujoco.MjModel, ignored: Sequence[int], margin: float, home: np.ndarray | None
) -> list[tuple[int, int]]:
    arm = _arm_geoms(mj_model)
    still = [geom for geom in _still_geoms(mj_model) if geom not in ignored]
    for geom in (*arm, *still):
        if mj_model.geom_type[geom] not in _SOLID:
            raise ValueError(
                f"geom {mj_model.geom(geom).name!r} is a "
                f"{mujoco.mjtGeom(mj_model.geom_type[geom]).name}; clearance is known of planes, "
                "spheres, capsules, boxes and cylinders"
            )
    pairs = [(a, b) for a, b in itertools.combinations(arm, 2) if not _joined(mj_model, a, b)]
    pairs += [(a, b) for a in still for b in arm if not _joined(mj_model, a, b)]
    return _reachable(mj_model, _apart_at_home(mj_model, pairs, home, margin), margin)


def _make_clearances(
    pairs: np.ndarray, cores: np.ndarray, planes: int, take: np.ndarray | None
) -> Callable[[Poses], jax.Array]:
    """`(poses) -> [P] float32` for pairs `[P, 2]` with cores `[P, 2, 5]`, the planes' first.

    The poses are of all geoms, of which those in `take` count, or of the geoms of the pairs alone.

    Batches are the last axis inside, where vmap would make them the first: on CPU the pairs'
    constants are then scalars to a vector of environments, which is 8 times as fast.
    """
    rows = np.unique(pairs, return_inverse=True)[1]
    used = slice(None) if take is None else take
    first, second = rows.reshape(-1, 2).T

    def many(xpos: jax.Array, xmat: jax.Array) -> jax.Array:
        """`[N, ngeom, 3]` and `[N, ngeom, 3, 3]` to `[N, P]`."""
        pos = _computed_once(jnp.transpose(xpos, (2, 1, 0))[:, used])
        mat = _computed_once(jnp.transpose(xmat, (2, 3, 1, 0))[:, :, used])
        one, other = (
            _Cores.of(cores[:, side], pos[:, which], mat[:, :, which])
            for side, which in enumerate((first, second))
        )
        flat = _above_planes(one[:planes], other[:planes])
        solid = _between(one[planes:], other[planes:])
        return jnp.concatenate([flat, solid]).T

    # Traced once for each shape, however many programs call it.
    once = _called_once(jax.jit(many))

    def clearances(poses: Poses) -> jax.Array:
        if not len(pairs):
            return jnp.full((1,), jnp.inf, jnp.float32)
        return once(poses.geom_xpos, poses.geom_xmat)

    return clearances


@dataclasses.dataclass(frozen=True)
class _Cores:
    """One side of all pairs.

    Attributes:
      half: `[3][P, 1]`, half extents of the core, m.
      disc: `[P, 1]`, the core's radius around its z axis where it is a disc, m.
      radius: `[P, 1]`, of the sphere that sweeps the core, m.
      pos: `[3, P, N]`, m.
      mat: `[3, 3, P, N]`.
    """

    half: np.ndarray
    disc: np.ndarray
    radius: np.ndarray
    pos: jax.Array
    mat: jax.Array

    @classmethod
    def of(cls, sizes: np.ndarray, pos: jax.Array, mat: jax.Array) -> _Cores:
        sizes = sizes.T[..., None]
        return cls(sizes[:3], sizes[3], sizes[4], _computed_once(pos), _computed_once(mat))

    def __getitem__(self, rows: slice) -> _Cores:
        return _Cores(
            self.half[:, rows],
            self.disc[rows],
            self.radius[rows],
            self.pos[:, rows],
            self.mat[:, :, rows],
        )

    def reach(self, direction: list[jax.Array]) -> jax.Array:
        """How far the core reaches from its centre along a unit vector in its frame, m."""
        reach = _dot([jnp.abs(x) for x in direction], self.half)
        if self.disc.any():
            reach += self.disc * jnp.sqrt(jnp.square(direction[0]) + jnp.square(direction[1]))
        return reach

    def nearest(self, point: list[jax.Array]) -> list[jax.Array]:
        """The point of the core that is nearest to one in its frame."""
        # `jnp.clip` keeps NaNs, at three times the instructions.
        near = [
            jnp.where(x > h, h, jnp.where(x < -h, -h, x))
            for x, h in zip(point, self.half, strict=True)
        ]
        if not self.disc.any():
            return near
        squared = jnp.square(point[0]) + jnp.square(point[1])
        ratio = self.disc * jax.lax.rsqrt(jnp.asarray(squared + np.float32(1e-12)))
        scale = jnp.where(ratio < 1, ratio, np.float32(1.0))
        round_ = [
            jnp.where(self.disc > 0, x * scale, n) for x, n in zip(point[:2], near[:2], strict=True)
        ]
        return [*round_, near[2]]


def _above_planes(planes: _Cores, links: _Cores) -> jax.Array:
    """Exact: `[P, N] float32`, m."""
    normal = planes.mat[:, 2]
    height = _dot(normal, links.pos - planes.pos)
    tilt = [_dot(normal, links.mat[:, i]) for i in range(3)]
    return height - links.reach(tilt) - links.radius


def _between(one: _Cores, other: _Cores) -> jax.Array:
    """By alternating projections, in the frame of the first: `[P, N] float32`, m."""
    apart = other.pos - one.pos
    place = [_computed_once(_dot(one.mat[:, i], apart)) for i in range(3)]
    rotation = [
        [_computed_once(_dot(one.mat[:, i], other.mat[:, j])) for j in range(3)] for i in range(3)
    ]
    columns = [list(column) for column in zip(*rotation, strict=True)]
    here = one.nearest(place)
    there = place
    for _ in range(_PROJECTIONS):
        way = [x - p for x, p in zip(here, place, strict=True)]
        local = other.nearest([_dot(column, way) for column in columns])
        there = [p + _dot(row, local) for p, row in zip(place, rotation, strict=True)]
        here = one.nearest(there)
    gap = [y - x for x, y in zip(here, there, strict=True)]
    shortest = jax.lax.rsqrt(_dot(gap, gap) + np.float32(1e-12))
    normal = [x * shortest for x in gap]
    turned = [_dot(column, normal) for column in columns]
    # The slab between the cores across the gap is a lower bound, whatever the gap: what the
    # projections have not reached yet makes an arm stay further away, never too near.
    slab = _dot(normal, place) - one.reach(normal) - other.reach(turned)
    return jnp.where(slab > 0, slab, np.float32(0.0)) - one.radius - other.radius


def _apart_at_home(
    model: mujoco.MjModel, pairs: list[tuple[int, int]], home: np.ndarray | None, margin: float
) -> list[tuple[int, int]]:
    """The pairs without those that overlap by design."""
    if home is None:
        home = model.key_qpos[0] if model.nkey else model.qpos0
    kept = []
    for pair, distance in zip(pairs, _distances(model, pairs, home, margin), strict=True):
        if distance >= margin:
            kept.append(pair)
        elif _joints_between(model, *pair) > _MAY_OVERLAP:
            names = " and ".join(repr(model.geom(geom).name) for geom in pair)
            raise ValueError(
                f"geoms {names} are {1000 * distance:.1f} mm apart at home: give a home where the "
                f"arm is free by {1000 * margin:g} mm"
            )
    return kept


def _reachable(
    model: mujoco.MjModel, pairs: list[tuple[int, int]], margin: float
) -> list[tuple[int, int]]:
    """The pairs that come near each other in some random pose, its joints often at a limit."""
    random = np.random.default_rng(0)
    single = np.isin(model.jnt_type, (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE))
    joints = np.flatnonzero(single)
    turn = np.where(model.jnt_type[joints] == mujoco.mjtJoint.mjJNT_HINGE, np.pi, 1.0)
    limited = model.jnt_limited[joints].astype(bool)[:, None]
    low, high = np.where(limited, model.jnt_range[joints], np.stack([-turn, turn], axis=1)).T
    least = np.full(len(pairs), np.inf)
    near = margin + _REACH_SLACK
    for _ in range(_REACH_POSES):
        share = np.clip(random.uniform(-0.25, 1.25, len(joints)), 0.0, 1.0)
        qpos = model.qpos0.copy()
        qpos[model.jnt_qposadr[joints]] = low + share * (high - low)
        open_ = np.flatnonzero(least > near)
        found = _distances(model, [pairs[i] for i in open_], qpos, near)
        least[open_] = np.minimum(least[open_], found)
    return [pair for pair, distance in zip(pairs, least, strict=True) if distance <= near]


def _distances(
    model: mujoco.MjModel, pairs: list[tuple[int, int]], qpos: np.ndarray, most: float
) -> np.ndarray:
    """By MuJoCo C, `[P]`; more than `most` where a pair is further apart, m."""
    data, points = mujoco.MjData(model), np.zeros(6)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    return np.asarray(
        [mujoco.mj_geomDistance(model, data, a, b, most + 1e-3, points) for a, b in pairs]
    )


def _is_free_body(model: mujoco.MjModel, body: int) -> bool:
    root = model.body_rootid[body]
    joints = model.body_jntadr[root] + np.arange(model.body_jntnum[root])
    return bool((model.jnt_type[joints] == mujoco.mjtJoint.mjJNT_FREE).any())


def _shown(model: mujoco.MjModel) -> list[int]:
    return [int(g) for g in np.flatnonzero(model.geom_group < _FIRST_HIDDEN_GROUP)]


def _still_geoms(model: mujoco.MjModel) -> list[int]:
    return [g for g in _shown(model) if model.body_weldid[model.geom_bodyid[g]] == 0]


def _arm_geoms(model: mujoco.MjModel) -> list[int]:
    moving = [g for g in _shown(model) if model.body_weldid[model.geom_bodyid[g]] != 0]
    return [g for g in moving if not _is_free_body(model, model.geom_bodyid[g])]


def _joined(model: mujoco.MjModel, one: int, other: int) -> bool:
    """Whether two geoms are of one rigid part, or of neighbours in the chain.

    The world is nobody's neighbour, but a base that stands in it is its first link's.
    """
    body, weld = model.geom_bodyid[[one, other]], model.body_weldid
    if weld[body[0]] == weld[body[1]]:
        return True
    for below, above in (body, body[::-1]):
        parent = model.body_parentid[weld[below]]
        if parent != 0 and above != 0 and weld[parent] == weld[above]:
            return True
    return False


def _joints_between(model: mujoco.MjModel, one: int, other: int) -> int:
    """Joints on the way through the tree of bodies from one geom to the other."""

    def ancestors(geom: int) -> list[int]:
        bodies = [int(model.geom_bodyid[geom])]
        while bodies[-1]:
            bodies.append(int(model.body_parentid[bodies[-1]]))
        return bodies

    way = set(ancestors(one)) ^ set(ancestors(other))
    return int(sum(model.body_jntnum[body] for body in way))


def _core(model: mujoco.MjModel, geom: int) -> list[float]:
    """Half extents of a box, radius of a disc, and radius of the sphere that sweeps their sum.

    A capsule is a segment, a cylinder a disc with a height: both are a box without width.
    """
    kind, size = model.geom_type[geom], model.geom_size[geom]
    if kind == _SPHERE:
        return [0.0, 0.0, 0.0, 0.0, size[0]]
    if kind == _CAPSULE:
        return [0.0, 0.0, size[1], 0.0, size[0]]
    if kind == _CYLINDER:
        radius = min(_ROUNDING, size[:2].min() / 2)
        return [0.0, 0.0, size[1] - radius, size[0] - radius, radius]
    if kind == _BOX:
        radius = min(_ROUNDING, size.min() / 2)
        return [*(size - radius), 0.0, radius]
    return [0.0] * 5


def _dot(one: _Vector, other: _Vector) -> jax.Array:
    return one[0] * other[0] + one[1] * other[1] + one[2] * other[2]


def _computed_once(x: jax.Array) -> jax.Array:
    """The same numbers; XLA computes them before what reads them, and not again in each of it."""
    return jax.lax.reduce_precision(x, exponent_bits=8, mantissa_bits=23)
