"""Reach a point in the air with the gripper."""

from __future__ import annotations

import functools
from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np

from mjx_arm.envs.arm import Arm
from mjx_arm.envs.state import EnvState, Snapshot
from mjx_arm.envs.tasks.base import Obstacle, Reward, TaskConfig, find_marker
from mjx_arm.kinematics import Poses, make_kinematics
from mjx_arm.options import NotNegative, Positive, options
from mjx_arm.scene import Scene
from mjx_arm.varies import Params, Varies

_TARGET = "target"
_BOX = "reach_box"
# Targets that are sampled at once. The first one that is far enough from home is taken.
_CANDIDATES = 16


@options
class ReachConfig(TaskConfig):
    """Options of the task `reach`.

    The reward `completion` pays for being near the target. What a step without success can pay is
    bounded, so that finishing is worth more than waiting near the target: at discount 0.99 waiting
    for ever pays at most 100 times `completion_reach`, half of `success_reward`.

    Attributes:
      threshold: largest distance between the grasp site and the target that counts as success, m.
      start_distance: smallest distance between the two at the start of an episode, m.
      success_reward: paid once, on success.
      completion_reach: most that a step without success pays, reward `completion`.
      completion_decay: how fast that falls with the distance, per decimetre, reward `completion`.
    """

    threshold: Positive = 0.02
    start_distance: Positive = 0.1
    success_reward: float = 100.0
    completion_reach: NotNegative = 0.5
    completion_decay: Positive = 1.0

    def check(self) -> None:
        """Rejects an episode that could start in success."""
        if self.start_distance <= self.threshold:
            raise ValueError(
                f"start_distance must be above threshold = {self.threshold} m, "
                f"got {self.start_distance}"
            )


class Reach:
    """Bring the grasp site to a target.

    The scene needs a visible sphere `target` without contacts, a geom of the world, whose place is
    that of environment A; and a numeric `reach_box`: centre x, y, z and half extents x, y, z of the
    target's places in environment B, m.

    It measures the `distance` between the grasp site and the target (m) and `success` (bool).

    Raises:
      ValueError: the scene lacks one of these, it is of another kind, or the target of environment
        A or the whole box is too near to the grasp site in the keyframe `home`.
    """

    def __init__(self, config: ReachConfig, scene: Scene, arm: Arm):
        model = scene.mj_model
        self.config, self.arm = config, arm
        self.target_geom = find_marker(scene, _TARGET, "sphere")
        self._fixed = model.geom_pos[self.target_geom].astype(np.float32)
        self._low, self._high = _find_box(scene)
        poses = make_kinematics(model)(jnp.asarray(arm.home_qpos))
        self._home = np.asarray(poses.site_xpos[arm.grasp_site])
        self._check_distances(scene)
        self.varies: Varies = {"geom_pos": (self.target_geom,)}
        self.rewards: Mapping[str, Reward] = {
            "completion": functools.partial(completion_reward, config),
            "sparse": functools.partial(sparse_reward, config),
        }
        self.feature_scales = (*[5.0] * 3, *[10.0] * 3)

    @property
    def obstacles(self) -> tuple[Obstacle, ...]:
        """None: the target has no contacts."""
        return ()

    def fixed_placement(self) -> jax.Array:
        """The target's place in the scene, `[3] float32`, m."""
        return jnp.asarray(self._fixed)

    def sample_placement(self, key: jax.Array) -> jax.Array:
        """A place for the target, `[3] float32`, m. Consumes the key.

        It is uniform in those parts of the box that are at least `start_distance` from the grasp
        site in the keyframe `home`, so that home is always a start that the task accepts.
        """
        places = jax.random.uniform(key, (_CANDIDATES, 3), jnp.float32, self._low, self._high)
        far = _distance(places - self._home) >= self.config.start_distance
        return jnp.where(jnp.any(far), places[jnp.argmax(far)], self._farthest)

    def start(
        self, qpos: jax.Array, ctrl: jax.Array, placement: jax.Array
    ) -> tuple[jax.Array, jax.Array, Params]:
        """Moves the target to its place."""
        return qpos, ctrl, {"geom_pos": placement[None]}

    def accepts(self, poses: Poses, placement: jax.Array) -> jax.Array:
        """Whether the grasp site is at least `start_distance` from the target."""
        offset = poses.site_xpos[self.arm.grasp_site] - placement
        return _distance(offset) >= self.config.start_distance

    def measure(self, state: EnvState) -> dict[str, jax.Array]:
        """`distance` and `success` of a state; see the class."""
        distance = _distance(self._offset(state))
        return {
            "distance": distance,
            "success": (distance <= self.config.threshold) & ~state.physics.diverged,
        }

    def features(self, state: EnvState) -> jax.Array:
        """The target's position and the way to it from the grasp site, m."""
        return jnp.concatenate([state.params["geom_pos"][0], self._offset(state)])

    @property
    def _farthest(self) -> np.ndarray:
        """The corner of the box that is farthest from the grasp site at home."""
        return np.where(self._home - self._low > self._high - self._home, self._low, self._high)

    def _offset(self, state: EnvState) -> jax.Array:
        site = state.physics.poses.site_xpos[self.arm.grasp_site]
        return state.params["geom_pos"][0] - site

    def _check_distances(self, scene: Scene) -> None:
        places = {f"geom {_TARGET!r}": self._fixed, f"numeric {_BOX!r}": self._farthest}
        for what, place in places.items():
            distance = float(np.linalg.norm(place - self._home))
            if distance < self.config.start_distance:
                raise ValueError(
                    f"scene {scene.name!r}: {what} must reach at least {self.config.start_distance}"
                    f" m (start_distance) away from the grasp site in the keyframe 'home', got "
                    f"{distance:.3f} m"
                )


def completion_reward(
    config: ReachConfig, before: Snapshot, after: Snapshot, action: jax.Array
) -> dict[str, jax.Array]:
    """Pays a bounded amount for nearness, or on success `success_reward`; see `ReachConfig`."""
    decimetres = after.measured["distance"] * 10.0
    reach = config.completion_reach * jnp.exp(-config.completion_decay * decimetres)
    success = after.measured["success"]
    return {
        "reach": jnp.where(success, jnp.zeros_like(reach), reach),
        **sparse_reward(config, before, after, action),
    }


def sparse_reward(
    config: ReachConfig, before: Snapshot, after: Snapshot, action: jax.Array
) -> dict[str, jax.Array]:
    """Pays for success alone."""
    del before, action
    success = after.measured["success"]
    return {"success": jnp.where(success, jnp.float32(config.success_reward), jnp.float32(0.0))}


def _distance(offset: jax.Array) -> jax.Array:
    return jnp.sqrt(jnp.sum(jnp.square(offset), axis=-1))


def _find_box(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corner of the target's places, `[3] float32` each, m."""
    values = scene.numbers(_BOX, 6).astype(np.float32)
    if (values[3:] < 0).any():
        raise ValueError(
            f"scene {scene.name!r}: numeric {_BOX!r} must have half extents of 0 or more, got "
            f"{values[3:].tolist()}"
        )
    return values[:3] - values[3:], values[:3] + values[3:]
