"""What a task is: where its objects are, what it measures, and what it pays for."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Protocol

import jax
import numpy as np

from mjx_arm.envs.arm import Arm
from mjx_arm.envs.collision import Obstacle
from mjx_arm.envs.state import EnvState, Placement, Snapshot
from mjx_arm.kinematics import Poses
from mjx_arm.options import options
from mjx_arm.scene import Scene
from mjx_arm.varies import Params, Varies

# `(before, after, action [] int32)` -> named terms, each `[] float32`; the reward is their sum.
Reward = Callable[[Snapshot, Snapshot, jax.Array], dict[str, jax.Array]]


@options
class TaskConfig:
    """Options of a task; a task's own class derives from this one."""


class Task(Protocol):
    """A task in a scene. Its functions are pure, of one environment; jit- and vmap-able."""

    @property
    def rewards(self) -> Mapping[str, Reward]:
        """Rewards by name; the first one is the default."""
        ...

    @property
    def varies(self) -> Varies:
        """Which rows of the model's fields the task's params replace."""
        ...

    @property
    def obstacles(self) -> Sequence[Obstacle]:
        """What a starting arm keeps clear of."""
        ...

    @property
    def feature_scales(self) -> Sequence[float]:
        """Factors that bring `features` to a size of about 1."""
        ...

    def fixed_placement(self) -> Placement:
        """Where the objects always are in environment A."""
        ...

    def sample_placement(self, key: jax.Array) -> Placement:
        """Where the objects are in environment B; same structure. Consumes the key."""
        ...

    def start(
        self, qpos: jax.Array, ctrl: jax.Array, placement: Placement
    ) -> tuple[jax.Array, jax.Array, Params]:
        """Puts the objects into a start whose arm is in place already.

        Args:
          qpos: `[nq] float32`.
          ctrl: `[nu] float32`.
          placement: as sampled.

        Returns:
          `qpos`, `ctrl`, and the params of the episode.
        """
        ...

    def accepts(self, poses: Poses, placement: Placement) -> jax.Array:
        """Whether a start fits the task, `[] bool`; the arm is free already."""
        ...

    def measure(self, state: EnvState) -> dict[str, jax.Array]:
        """Named quantities of a state, bools and float32, each `[]`.

        `success` (bool) is among them: the episode terminates in it. All are metrics of the run,
        entries of `info`, and what rewards are computed from.
        """
        ...

    def features(self, state: EnvState) -> jax.Array:
        """State features of the task's objects, `[F] float32`."""
        ...


TaskFactory = Callable[[TaskConfig, Scene, Arm], Task]


def rectangle(scene: Scene, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Centre and half extents, `[2] float32` each, m, of a scene's numeric `x y half_x half_y`.

    Raises:
      ValueError: the scene has no such numeric, or an extent is negative.
    """
    values = scene.numbers(name, 4).astype(np.float32)
    if (values[2:] < 0).any():
        raise ValueError(
            f"scene {scene.name!r}: numeric {name!r} must have half extents of 0 or more"
        )
    return values[:2], values[2:]
