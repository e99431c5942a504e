"""What a task is: where its objects are, what it measures, and what it pays for."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Protocol

import jax
import numpy as np

from mjx_arm.envs.collision import Obstacle
from mjx_arm.envs.state import EnvState, Placement, Snapshot
from mjx_arm.kinematics import Poses
from mjx_arm.options import options
from mjx_arm.render.geoms import SUPPORTED_TYPES, visible_geoms
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
        """Whether a start fits the task, `[] bool`; asked only if the arm touches nothing."""
        ...

    def measure(self, state: EnvState) -> dict[str, jax.Array]:
        """Named quantities of a state, bools and float32, each `[]`.

        `success` (bool) is among them: the episode terminates in it. All are metrics of the run,
        entries of `info`, and what rewards are computed from. `register` takes the units of the
        float32 ones.
        """
        ...

    def features(self, state: EnvState) -> jax.Array:
        """State features of the task's objects, `[F] float32`."""
        ...


class SizedTask(Task, Protocol):
    """A task whose objects may have another size in each episode."""

    def with_params(self, varies: Varies, params: Params) -> Task:
        """The same task with the sizes of an episode.

        Args:
          varies: which rows of the model's fields `params` replace.
          params: of the episode.
        """
        ...


class EasedTask(Task, Protocol):
    """A task that can make some starts easier: a curriculum over the starts."""

    def ease(self, key: jax.Array, qpos: jax.Array, ctrl: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Changes a start in which the arm touches nothing. Consumes the key.

        Args:
          key: a PRNG key.
          qpos: `[nq] float32`.
          ctrl: `[nu] float32`.

        Returns:
          `qpos [nq] float32` and `ctrl [nu] float32`.
        """
        ...


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


def find_marker(scene: Scene, name: str, kind: str) -> int:
    """Id of a geom that marks a place: it is visible and touches nothing.

    Args:
      scene: the scene.
      name: of the geom.
      kind: `"sphere"`, `"cylinder"`, ...

    Raises:
      ValueError: the scene has no such geom, or the geom is of another kind, on a body, invisible,
        or has contacts.
    """
    model, geom = scene.mj_model, scene.find("geom", name)
    where = f"scene {scene.name!r}: geom {name!r}"
    if SUPPORTED_TYPES.get(int(model.geom_type[geom])) != kind:
        raise ValueError(f"{where} must be a {kind}")
    if model.geom_bodyid[geom] != 0:
        raise ValueError(f"{where} must be in the worldbody, got a geom of a body")
    in_pairs = geom in model.pair_geom1 or geom in model.pair_geom2
    if model.geom_contype[geom] or model.geom_conaffinity[geom] or in_pairs:
        raise ValueError(
            f"{where} must have no contacts: set contype and conaffinity to 0, and name it in no "
            "contact pair"
        )
    if not visible_geoms(model)[geom]:
        raise ValueError(f"{where} must be visible: in a group from 0 to 2, with alpha above 0")
    return geom
