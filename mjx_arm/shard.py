"""The part of one device in work that several devices share along an axis of a mesh."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np

T = TypeVar("T")


@dataclasses.dataclass(frozen=True)
class Shard:
    """One of the equal parts of a computation inside `jax.shard_map`; by default the whole.

    With the default each function returns its argument, so a program for one device has no extra
    operations.

    Attributes:
      axis: name of the mesh axis, or None for the whole.
      count: number of parts, which is the size of the axis.
    """

    axis: str | None = None
    count: int = 1

    def part(self, rows: int) -> int:
        """Rows of each part, of a total that `count` divides."""
        return rows // self.count

    def fold(self, key: jax.Array) -> jax.Array:
        """A key of this part, from one that all parts share. Consumes the key."""
        if self.axis is None:
            return key
        return jax.random.fold_in(key, jax.lax.axis_index(self.axis))

    def own(self, rows: jax.Array) -> jax.Array:
        """The rows of this part, `[N / count, ...]`, of `[N, ...]` that every part knows."""
        if self.axis is None:
            return rows
        size = self.part(len(rows))
        return jax.lax.dynamic_slice_in_dim(rows, jax.lax.axis_index(self.axis) * size, size)

    def mean(self, tree: T) -> T:
        """The mean over the parts of each array of a tree."""
        return tree if self.axis is None else _as_one(tree, self.axis, jax.lax.pmean)

    def total(self, tree: T) -> T:
        """The sum over the parts of each array of a tree."""
        return tree if self.axis is None else _as_one(tree, self.axis, jax.lax.psum)

    def largest(self, tree: T) -> T:
        """The maximum over the parts of each array of a tree."""
        return tree if self.axis is None else jax.lax.pmax(tree, self.axis)

    def keep_first(self, tree: T) -> T:
        """The tree on the first part and zeros on the others: `total` gives it back."""
        if self.axis is None:
            return tree
        first = jax.lax.axis_index(self.axis) == 0
        return jax.tree.map(lambda x: jnp.where(first, x, jnp.zeros_like(x)), tree)


WHOLE = Shard()


def _as_one(tree: T, axis: str, reduce: Callable[[jax.Array, str], jax.Array]) -> T:
    """Joins all arrays of one dtype and reduces them in one message.

    Between processes of CPUs each array would be a message of its own: the gradients of a network
    with 20 arrays took 17 ms as a tree and 4.4 ms as one array.
    """
    leaves, structure = jax.tree.flatten(jax.tree.map(jnp.asarray, tree))
    reduced = list(leaves)
    # In the order of the leaves, which is the same in every process.
    for dtype in dict.fromkeys(x.dtype for x in leaves):
        same = [i for i, x in enumerate(leaves) if x.dtype == dtype]
        ends = np.cumsum([leaves[i].size for i in same])[:-1].tolist()
        joined = reduce(jnp.concatenate([leaves[i].ravel() for i in same]), axis)
        for i, part in zip(same, jnp.split(joined, ends), strict=True):
            reduced[i] = part.reshape(leaves[i].shape)
    return jax.tree.unflatten(structure, reduced)
