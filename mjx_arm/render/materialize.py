"""A wall behind an image, so that XLA casts its rays once and not once per consumer."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap

# No packed pixel has this value: where nothing is hit, the colour is black.
_IMPOSSIBLE = 0xFFFFFFFF


@custom_vmap
def materialize(packed: jax.Array, *others: jax.Array) -> tuple[jax.Array, ...]:
    """Returns its arguments unchanged, but computed before anything that reads them.

    XLA on CPU fuses a producer into every consumer, which repeats the ray cast for each, and
    `optimization_barrier` does not keep it from that. A branch that depends on the data does.
    The condition is of the whole batch, because a batched branch would become a select; hence
    the rule for `vmap`.

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
