"""Push a cube to a marked place on the table."""

from __future__ import annotations

import copy
import functools
from collections.abc import Mapping
from typing import TypeAlias

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_arm.envs.arm import Arm
from mjx_arm.envs.state import EnvState, Snapshot
from mjx_arm.envs.tasks.base import Obstacle, Reward, TaskConfig, find_marker, rectangle
from mjx_arm.envs.tasks.rest import check_rests
from mjx_arm.kinematics import Poses
from mjx_arm.options import NotNegative, Positive, options
from mjx_arm.scene import Scene
from mjx_arm.varies import Params, Varies

_CUBE = "cube"
_MARK = "mark"
_RECTANGLE = "push_rectangle"
# Pairs of places that are sampled at once. The first one that is far enough apart is taken.
_CANDIDATES = 32

Places: TypeAlias = dict[str, jax.Array]
"""`cube` and `mark`, `[2] float32` each: their places on the table, m."""


@options
class PushConfig(TaskConfig):
    """Options of the task `push`.

    The reward `completion` pays for being near the cube and for a cube near the mark. What a step
    without success can pay is bounded, so that finishing is worth more than waiting: at discount
    0.99 waiting for ever pays at most 100 times `completion_reach + completion_push`, which is less
    than `success_reward`.

    Attributes:
      threshold: largest horizontal distance between cube and mark that counts as success, m.
      start_distance: smallest horizontal distance between the two at the start of an episode, m.
      success_reward: paid once, on success.
      completion_reach: most that a step without success pays for the gripper near the cube, reward
        `completion`.
      completion_push: most that a step without success pays for the cube near the mark, reward
        `completion`.
      completion_decay: how fast both fall with the distance, per decimetre, reward `completion`.
    """

    threshold: Positive = 0.03
    start_distance: Positive = 0.1
    success_reward: float = 100.0
    completion_reach: NotNegative = 0.2
    completion_push: NotNegative = 0.5
    completion_decay: Positive = 1.0

    def check(self) -> None:
        """Rejects an episode that could start in success."""
        if self.start_distance <= self.threshold:
            raise ValueError(
                f"start_distance must be above threshold = {self.threshold} m, "
                f"got {self.start_distance}"
            )


class Push:
    """Push the cube to the mark.

    The scene needs a box `cube` on a free joint `cube`; a visible cylinder `mark` without contacts,
    a geom of the world; and a numeric `push_rectangle`: centre x, y and half extents x, y of the
    places of both in environment B, m. In environment A the cube is where the keyframe `home` has
    it, and the mark where the scene has it.

    It measures the horizontal `distance` between cube and mark (m), the distance `to_cube` between
    the grasp site and the cube's centre (m), and `success` (bool).

    Raises:
      ValueError: the scene lacks one of these, it is of another kind, or cube and mark are too near
        to each other in environment A or everywhere in the rectangle.
    """

    def __init__(self, config: PushConfig, scene: Scene, arm: Arm):
        model = scene.mj_model
        self.config, self.arm = config, arm
        self.cube_geom, self.cube_qpos = _find_cube(scene, arm)
        self.mark_geom = find_marker(scene, _MARK, "cylinder")
        centre, extent = rectangle(scene, _RECTANGLE)
        self._low, self._high = centre - extent, centre + extent
        self._cube_radius = float(np.linalg.norm(model.geom_size[self.cube_geom]))
        self._cube_half_height = float(model.geom_size[self.cube_geom, 2])
        # A larger cube lies higher than in the scene, by this difference of the half heights, m.
        self._cube_raised: jax.Array | None = None
        mark = model.geom_pos[self.mark_geom].astype(np.float32)
        self._mark_height = mark[2:]
        self._fixed = {"cube": arm.home_qpos[self.cube_qpos : self.cube_qpos + 2], "mark": mark[:2]}
        self._check_distances(scene)
        self.varies: Varies = {"geom_pos": (self.mark_geom,)}
        self.rewards: Mapping[str, Reward] = {
            "completion": functools.partial(completion_reward, config),
            "sparse": functools.partial(sparse_reward, config),
        }
        self.feature_scales = (*[5.0] * 3, *[1.0] * 4, *[10.0] * 3, *[5.0] * 2, *[10.0] * 2)

    @property
    def obstacles(self) -> tuple[Obstacle, ...]:
        """The cube by its bounding sphere."""
        return (Obstacle(self.cube_geom, self._cube_radius),)

    def with_params(self, varies: Varies, params: Params) -> Push:
        """The same task with the cube's size in an episode, where that varies."""
        rows = varies.get("geom_size", ())
        if self.cube_geom not in rows:
            return self
        task = copy.copy(self)
        half = params["geom_size"][rows.index(self.cube_geom), 2]
        task._cube_raised = half - self._cube_half_height
        return task

    def fixed_placement(self) -> Places:
        """The cube's place in the keyframe `home`, and the mark's in the scene."""
        return {name: jnp.asarray(place) for name, place in self._fixed.items()}

    def sample_placement(self, key: jax.Array) -> Places:
        """Places of cube and mark in the rectangle, `start_distance` or more apart.

        They are uniform among all such pairs of places. Consumes the key.
        """
        pairs = jax.random.uniform(key, (_CANDIDATES, 2, 2), jnp.float32, self._low, self._high)
        far = _norm(pairs[:, 1] - pairs[:, 0]) >= self.config.start_distance
        cube, mark = pairs[jnp.argmax(far)]
        centre = (self._low + self._high) / np.float32(2)
        corner = jnp.where(cube > centre, self._low, self._high)
        return {"cube": cube, "mark": jnp.where(jnp.any(far), mark, corner)}

    def start(
        self, qpos: jax.Array, ctrl: jax.Array, placement: Places
    ) -> tuple[jax.Array, jax.Array, Params]:
        """Puts cube and mark on their places."""
        mark = jnp.concatenate([placement["mark"], jnp.asarray(self._mark_height)])
        qpos = qpos.at[self.cube_qpos : self.cube_qpos + 2].set(placement["cube"])
        if self._cube_raised is not None:
            qpos = qpos.at[self.cube_qpos + 2].add(self._cube_raised)
        return qpos, ctrl, {"geom_pos": mark[None]}

    def accepts(self, poses: Poses, placement: Places) -> jax.Array:
        """Every start with a free arm fits."""
        del poses, placement
        return jnp.ones((), jnp.bool_)

    def measure(self, state: EnvState) -> dict[str, jax.Array]:
        """`distance`, `to_cube` and `success` of a state; see the class."""
        distance = _norm(self._way_to_mark(state))
        return {
            "distance": distance,
            "to_cube": _norm(self._way_to_cube(state)),
            "success": (distance <= self.config.threshold) & ~state.physics.diverged,
        }

    def features(self, state: EnvState) -> jax.Array:
        """Where cube and mark are, and the ways to them, `[14] float32`.

        The cube's position (m) and quaternion, the way to it from the grasp site (m), the mark's
        place and the cube's way to it (m).
        """
        cube = state.physics.qpos[self.cube_qpos : self.cube_qpos + 7]
        mark = state.params["geom_pos"][0, :2]
        return jnp.concatenate([cube, self._way_to_cube(state), mark, self._way_to_mark(state)])

    def _way_to_cube(self, state: EnvState) -> jax.Array:
        poses = state.physics.poses
        return poses.geom_xpos[self.cube_geom] - poses.site_xpos[self.arm.grasp_site]

    def _way_to_mark(self, state: EnvState) -> jax.Array:
        cube = state.physics.poses.geom_xpos[self.cube_geom]
        return state.params["geom_pos"][0, :2] - cube[:2]

    def _check_distances(self, scene: Scene) -> None:
        least = self.config.start_distance
        between = float(np.linalg.norm(self._fixed["mark"] - self._fixed["cube"]))
        if between < least:
            raise ValueError(
                f"scene {scene.name!r}: geom {_MARK!r} must be at least {least} m (start_distance) "
                f"away from the cube of the keyframe 'home', got {between:.3f} m"
            )
        # Of a cube in the centre the corners are the farthest places.
        widest = float(np.linalg.norm(self._high - self._low)) / 2
        if widest < least:
            raise ValueError(
                f"scene {scene.name!r}: numeric {_RECTANGLE!r} must have a half diagonal of at "
                f"least {least} m (start_distance), got {widest:.3f} m"
            )


def completion_reward(
    config: PushConfig, before: Snapshot, after: Snapshot, action: jax.Array
) -> dict[str, jax.Array]:
    """Pays a bounded amount for nearness, or on success `success_reward`; see `PushConfig`."""
    success = after.measured["success"]
    terms = {
        name: most * jnp.exp(-config.completion_decay * 10.0 * after.measured[distance])
        for name, most, distance in (
            ("reach", config.completion_reach, "to_cube"),
            ("push", config.completion_push, "distance"),
        )
    }
    return {
        **{name: jnp.where(success, jnp.zeros_like(term), term) for name, term in terms.items()},
        **sparse_reward(config, before, after, action),
    }


def sparse_reward(
    config: PushConfig, before: Snapshot, after: Snapshot, action: jax.Array
) -> dict[str, jax.Array]:
    """Pays for success alone."""
    del before, action
    success = after.measured["success"]
    return {"success": jnp.where(success, jnp.float32(config.success_reward), jnp.float32(0.0))}


def _norm(vectors: jax.Array) -> jax.Array:
    return jnp.sqrt(jnp.sum(jnp.square(vectors), axis=-1))


def _find_cube(scene: Scene, arm: Arm) -> tuple[int, int]:
    """Geom id of the cube, which lies level on the ground, and where its joint begins in `qpos`."""
    model, name = scene.mj_model, scene.name
    geom, joint = scene.find("geom", _CUBE), scene.find("joint", _CUBE)
    if model.geom_type[geom] != mujoco.mjtGeom.mjGEOM_BOX:
        raise ValueError(f"scene {name!r}: geom {_CUBE!r} must be a box")
    if model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_FREE:
        raise ValueError(f"scene {name!r}: joint {_CUBE!r} must be a free joint")
    if model.jnt_bodyid[joint] != model.geom_bodyid[geom]:
        raise ValueError(f"scene {name!r}: joint {_CUBE!r} must move the body of geom {_CUBE!r}")
    if model.geom_pos[geom].any() or abs(model.geom_quat[geom][0]) < 1 - 1e-9:
        raise ValueError(
            f"scene {name!r}: geom {_CUBE!r} must be at the origin of its body, and not turned"
        )
    start = int(model.jnt_qposadr[joint])
    pose, half = arm.home_qpos[start : start + 7], float(model.geom_size[geom, 2])
    if abs(pose[2] - half) > 1e-3 or np.abs(pose[4:6]).max() > 1e-3:
        raise ValueError(
            f"scene {name!r}: in the keyframe 'home' the cube must lie level on the ground at "
            f"height 0, its centre {half} m above it, got a height of {pose[2]:g} m and the "
            f"quaternion {pose[3:].tolist()}"
        )
    check_rests(scene, arm, start + 2, "cube")
    return geom, start
