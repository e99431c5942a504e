"""Small arithmetic in full float32 precision on every device, cheap inside a fused kernel."""

from __future__ import annotations

from typing import TypeVar

import jax
import jax.numpy as jnp

T = TypeVar("T")


def matvec(matrix: jax.Array, vector: jax.Array) -> jax.Array:
    """Returns `matrix [m, n]` times `vector [n]`; jnp.dot has less precision on accelerators."""
    return jnp.sum(matrix * vector, axis=-1)


def matmul(left: jax.Array, right: jax.Array) -> jax.Array:
    """Returns `left [m, k]` times `right [k, n]`, as `matvec`."""
    return jnp.sum(left[:, :, None] * right[None, :, :], axis=1)


def fence(tree: T) -> T:
    """Returns the floats of a tree unchanged, but computed before anything that reads them.

    XLA on CPU would compute what is one number a frame again at every pixel, in every kernel. It
    does not fuse what is rounded, even to the precision that it has.
    """

    def hold(x: jax.Array) -> jax.Array:
        floats = jnp.issubdtype(x.dtype, jnp.floating)
        return jax.lax.reduce_precision(x, 8, 23) if floats else x

    fenced: T = jax.tree.map(hold, tree)
    return fenced


def lesser(a: jax.Array, b: jax.Array) -> jax.Array:
    """Returns the smaller one. It is a single instruction, because it does not keep NaNs."""
    return jnp.where(a < b, a, b)


def greater(a: jax.Array, b: jax.Array) -> jax.Array:
    """Returns the larger one; see `lesser`."""
    return jnp.where(a > b, a, b)


def root(x: jax.Array) -> jax.Array:
    """Returns the square root, 0 where `x` is negative."""
    return jnp.sqrt(greater(x, jnp.zeros_like(x)))


def sign(x: jax.Array) -> jax.Array:
    """Returns -1 where `x` is negative, else 1: unlike jnp.sign it is never zero."""
    return jnp.where(x < 0, jnp.full_like(x, -1.0), jnp.full_like(x, 1.0))


def perpendicular(axis: jax.Array) -> jax.Array:
    """Returns two unit vectors, `[2, 3]`, that complete the unit vector `axis [3]` to a basis.

    Duff et al. 2017, Building an Orthonormal Basis, Revisited.
    """
    x, y, z = axis
    s = sign(z)
    a = -1 / (s + z)
    b = x * y * a
    first = jnp.stack([1 + s * x * x * a, s * b, -s * x])
    second = jnp.stack([b, s + y * y * a, -y])
    return jnp.stack([first, second])
