"""A fence after an image, so that XLA casts its rays once and not once per consumer."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap

# No packed pixel has this value: its geom id means that nothing is hit, and that is black.
_IMPOSSIBLE = 0xFFFFFFFF


@custom_vmap
def materialize(packed: jax.Array, *others: jax.Array) -> tuple[jax.Array, ...]:
    """Returns its arguments unchanged, but computed before anything that reads them.

    XLA on CPU fuses a producer into every consumer, which repeats the ray cast for each of them.
    `optimization_barrier` does not prevent it; a branch that depends on the data does. Under
    `vmap` a branch with one condition per frame would become a select. The rule for `vmap`
    therefore uses one condition for the whole batch.

    Args:
      packed: `[...] uint32`, packed pixels, at least one.
      *others: more arrays of the same computation.
    """
    values = (packed, *others)
    return jax.lax.platform_dependent(values, cpu=_branch, default=lambda arrays: arrays)


@materialize.def_vmap
def _materialize_batch(
    axis_size: int, in_batched: list[bool], *values: jax.Array
) -> tuple[tuple[jax.Array, ...], tuple[Any, ...]]:
    del axis_size
    return materialize(*values), tuple(in_batched)


def _branch(values: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
    first = values[0][(0,) * values[0].ndim]
    return jax.lax.cond(
        first != jnp.uint32(_IMPOSSIBLE),
        lambda arrays: arrays,
        lambda arrays: jax.tree.map(jnp.zeros_like, arrays),
        values,
    )
