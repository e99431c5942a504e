"""Samples what varies in an episode: a pure function of a key."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_arm.envs.randomisation.appearance import appearance_parts
from mjx_arm.envs.randomisation.config import RandomisationConfig, Ranges
from mjx_arm.envs.randomisation.dynamics import dynamics_parts
from mjx_arm.envs.randomisation.parts import Growth, Part
from mjx_arm.kinematics import find_camera
from mjx_arm.render.geoms import visible_geoms
from mjx_arm.varies import Params, Varies, merge_params, merge_varies

# Fields that change an image start with these.
_IMAGE_PREFIXES = (
    "body_pos",
    "body_quat",
    "cam_",
    "geom_",
    "headlight_",
    "image_",
    "light_",
    "mat_",
)
_NOT_IMAGE = ("geom_friction", "geom_solref", "geom_solimp", "image_delay")


@dataclasses.dataclass(frozen=True, eq=False)
class Randomiser:
    """Samples what varies by episode, besides what the task varies.

    Attributes:
      parts: what varies; empty if nothing does.
      ranges: the ranges.
      growth_steps: iterations of an environment until the ranges have their full width; 0 for full
        ranges from the start.
    """

    parts: tuple[Part, ...]
    ranges: Ranges
    growth_steps: int

    def __bool__(self) -> bool:
        """Whether anything varies."""
        return bool(self.parts)

    @functools.cached_property
    def varies(self) -> Varies:
        """The rows of the model that vary."""
        empty: Varies = {}
        return functools.reduce(merge_varies, (part.varies for part in self.parts), empty)

    @property
    def resizes(self) -> bool:
        """Whether objects have another size in each episode."""
        return "geom_size" in self.varies

    def sample(self, key: jax.Array, growth: Growth = 1.0) -> Params:
        """Samples the params of an episode. Consumes the key.

        Args:
          key: a PRNG key.
          growth: share of the ranges, 0 to 1.

        Returns:
          The values of the rows `varies`.
        """
        # One call: each has a cost of its own, in every environment at every step.
        numbers = jax.random.uniform(key, (sum(part.numbers for part in self.parts),), jnp.float32)
        pieces = jnp.split(numbers, np.cumsum([part.numbers for part in self.parts])[:-1])
        varies: Varies = {}
        params: Params = {}
        for part, piece in zip(self.parts, pieces, strict=True):
            made = {name: x.astype(jnp.float32) for name, x in part.make(piece, growth).items()}
            params = merge_params(varies, params, part.varies, made)
            varies = merge_varies(varies, part.varies)
        return params

    def growth(self, age: jax.Array) -> jax.Array:
        """Share of the ranges after `age [] int32` iterations, `[] float32`."""
        share = age.astype(jnp.float32) / np.float32(max(self.growth_steps, 1))
        return jnp.minimum(share, jnp.float32(1.0))


def make_randomiser(
    config: RandomisationConfig, mj_model: mujoco.MjModel, cameras: Sequence[str]
) -> Randomiser:
    """Makes the sampler of a configuration for a scene.

    Args:
      config: the ranges.
      mj_model: the scene.
      cameras: names of the cameras whose pose and field of view vary.

    Raises:
      ValueError: a camera is unknown, or see `appearance_parts`.
    """
    ranges = config.ranges
    if ranges == Ranges():
        return Randomiser((), ranges, 0)
    for name in cameras:
        find_camera(mj_model, name)
    parts = appearance_parts(mj_model, ranges, cameras) + dynamics_parts(mj_model, ranges)
    return Randomiser(tuple(parts), ranges, config.growth_steps if parts else 0)


def image_varies(mj_model: mujoco.MjModel, varies: Varies) -> Varies:
    """The rows that change an image: those whose params the replay stores."""
    visible = visible_geoms(mj_model, varies)
    found = {}
    for field, ids in varies.items():
        if field.startswith(_IMAGE_PREFIXES) and field not in _NOT_IMAGE:
            shown = tuple(i for i in ids if not field.startswith("geom_") or visible[i])
            if shown:
                found[field] = shown
    return found


def select_rows(varies: Varies, params: Params, wanted: Varies) -> Params:
    """The params of the rows `wanted`, which are some of the rows `varies`."""
    selected = {}
    for field, ids in wanted.items():
        have = varies[field]
        places = [have.index(i) for i in ids]
        value = params[field]
        selected[field] = value if places == [*range(len(have))] else value[np.asarray(places)]
    return selected
