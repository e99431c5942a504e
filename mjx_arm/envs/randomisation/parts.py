"""Parts of domain randomisation, each of which turns random numbers into params."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import TypeAlias

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_arm.varies import Params, Varies

Growth: TypeAlias = "jax.Array | float"
"""`[] float32` in 0..1: 0 for the scene as it is, 1 for the whole range."""


@dataclasses.dataclass(frozen=True)
class Part:
    """One thing that varies.

    Attributes:
      varies: the rows that it gives values to.
      numbers: number n of random numbers that it needs.
      make: `(numbers [n] float32 uniform in 0..1, growth []) -> Params` of those rows.
    """

    varies: Varies
    numbers: int
    make: Callable[[jax.Array, Growth], Params]


def between(
    uniform: jax.Array,
    least: float,
    greatest: float,
    own: np.ndarray | jax.Array | float,
    growth: Growth,
) -> jax.Array:
    """A value in a range that grows from the scene's own value.

    Args:
      uniform: `[...] float32` in 0..1.
      least: the least value of the range.
      greatest: its greatest value.
      own: the scene's own value, of any shape that broadcasts.
      growth: share of the range.

    Returns:
      `[...] float32`.
    """
    value = least + uniform * (greatest - least)
    if isinstance(growth, float) and growth == 1.0:
        return value
    return jnp.asarray(own + growth * (value - own))


def scaled(own: np.ndarray, factor: jax.Array) -> jax.Array:
    """The scene's own values times a factor, float32."""
    return jnp.asarray(own) * factor


def is_fixed(values: tuple[float, float], own: float) -> bool:
    """Whether a range holds nothing but the scene's own value."""
    return values == (own, own)


def free_bodies(mj_model: mujoco.MjModel) -> list[int]:
    """Ids of the bodies on free joints: the objects of a scene."""
    free = mj_model.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE)
    return sorted({int(body) for body in mj_model.jnt_bodyid[free]})


def geoms_of(mj_model: mujoco.MjModel, bodies: list[int]) -> list[int]:
    """Ids of the geoms of some bodies."""
    return [i for i in range(mj_model.ngeom) if int(mj_model.geom_bodyid[i]) in bodies]


def delay_of(uniform: jax.Array, most: int, growth: Growth) -> jax.Array:
    """A delay of 0 to `most` whole iterations, float32; all are equally likely at full growth.

    Args:
      uniform: `[...] float32`, random numbers in 0..1.
      most: the largest delay, iterations.
      growth: share of the range.
    """
    count = jnp.floor(uniform * (growth * most + 1))
    return jnp.minimum(count, jnp.full_like(count, most))
