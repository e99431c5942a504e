"""Convolution and max-pooling with gradients that are fast inside a scan on CPU.

There the gradient of `nn.Conv` takes 25 times as long inside `lax.scan` as outside, and what
autodiff and XLA make of the formulations below, left alone, twice as long as they need.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp


def convolve(x: jax.Array, kernel: jax.Array, stride: int) -> jax.Array:
    """Convolves `[B, H, W, C] float32` with `[K, K, C, F] float32`, padding "SAME".

    One matrix product over patches. The image is cut into blocks of `stride` pixels first, so that
    a patch is a few long runs of memory instead of many short ones.

    Returns:
      `[B, ceil(H / stride), ceil(W / stride), F] float32`.
    """
    batch, _, _, channels = x.shape
    size, features = kernel.shape[0], kernel.shape[-1]
    blocks = -(-size // stride)
    pads, counts = [], []
    for edge in x.shape[1:3]:
        count = -(-edge // stride)
        before = max((count - 1) * stride + size - edge, 0) // 2
        pads.append((before, (count - 1 + blocks) * stride - edge - before, 0))
        counts.append(count)
    # lax.pad, because the far end may lose pixels that no kernel reaches.
    x = jax.lax.pad(x, jnp.zeros((), x.dtype), ((0, 0, 0), *pads, (0, 0, 0)))
    height, width = (count - 1 + blocks for count in counts)
    x = x.reshape(batch, height, stride, width, stride, channels).transpose(0, 1, 3, 2, 4, 5)
    x = _computed_once(x.reshape(batch, height, width, stride * stride * channels))
    patches = [
        x[:, i : i + counts[0], j : j + counts[1]] for i in range(blocks) for j in range(blocks)
    ]
    # The kernel, padded to whole blocks, in the order of the patches: block, then pixel in it.
    spare = blocks * stride - size
    kernel = jnp.pad(kernel, ((0, spare), (0, spare), (0, 0), (0, 0)))
    kernel = kernel.reshape(blocks, stride, blocks, stride, channels, features)
    weights = kernel.transpose(5, 0, 2, 1, 3, 4).reshape(features, -1)
    return _product(jnp.concatenate(patches, axis=-1), weights)


def _computed_once(x: jax.Array) -> jax.Array:
    """The same `float32` values, and the same gradient, which XLA computes once.

    It does not fuse what comes before a reduction of precision into each of its consumers, as it
    would into the nine slices that make the patches; an optimization barrier is gone by then.
    """
    return jax.lax.reduce_precision(x, exponent_bits=8, mantissa_bits=23)


@jax.custom_vjp
def _product(rows: jax.Array, weights: jax.Array) -> jax.Array:
    """`[..., K] @ [F, K].T`, for many rows and small `K` and `F`."""
    return rows @ weights.T


def _product_fwd(
    rows: jax.Array, weights: jax.Array
) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
    return rows @ weights.T, (rows, weights)


def _product_bwd(
    saved: tuple[jax.Array, jax.Array], grad: jax.Array
) -> tuple[jax.Array, jax.Array]:
    rows, weights = saved
    features, length = weights.shape
    # Of two matrices, features first: other orders take twice as long, or copy the rows.
    of_weights = grad.reshape(-1, features).T @ rows.reshape(-1, length)
    return grad @ weights, of_weights


_product.defvjp(_product_fwd, _product_bwd)


def max_pool(x: jax.Array, size: int) -> jax.Array:
    """Max-pooling without overlap: `[B, H, W, C]` to `[B, H // size, W // size, C]`.

    Where several pixels of a window share the maximum, the first gets the gradient.
    """
    batch, height, width, channels = x.shape
    height, width = height // size, width // size
    x = x[:, : height * size, : width * size]
    return _max_of_windows(x.reshape(batch, height, size, width, size, channels), size)


@functools.partial(jax.custom_vjp, nondiff_argnums=(1,))
def _max_of_windows(windows: jax.Array, size: int) -> jax.Array:
    """Maximum over axes 2 and 4 of `[B, H, size, W, size, C]`.

    Its gradient remembers the place of each maximum in a byte; that of a maximum over axes takes
    10 to 30 times as long.
    """
    return _max_fwd(windows, size)[0]


def _max_fwd(windows: jax.Array, size: int) -> tuple[jax.Array, jax.Array]:
    largest = windows[:, :, 0, :, 0]
    place = jnp.zeros(largest.shape, jnp.uint8)
    for i in range(1, size * size):
        other = windows[:, :, i // size, :, i % size]
        place = jnp.where(other > largest, jnp.uint8(i), place)
        largest = jnp.maximum(largest, other)
    return largest, place


def _max_bwd(size: int, place: jax.Array, grad: jax.Array) -> tuple[jax.Array]:
    places = jnp.arange(size * size, dtype=jnp.uint8).reshape(size, 1, size, 1)
    return (jnp.where(place[:, :, None, :, None] == places, grad[:, :, None, :, None], 0.0),)


_max_of_windows.defvjp(_max_fwd, _max_bwd)
