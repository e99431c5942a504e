"""Arithmetic on packed pixels, two channels at a time; in whole numbers, the same everywhere."""

from __future__ import annotations

import jax
import jax.numpy as jnp

_RED_BLUE = 0x00FF00FF
_GREEN = 0x0000FF00
_COLOUR = 0x00FFFFFF


def average(packed: jax.Array, edge: int) -> jax.Array:
    """Averages blocks of `edge` by `edge` pixels, a power of two of at most 16.

    Args:
      packed: `[H * edge, W * edge] uint32`.
      edge: pixels along one side of a block.

    Returns:
      `[H, W] uint32`. The geom id is that of one pixel of each block.
    """
    height, width = packed.shape
    blocks = packed.reshape(height // edge, edge, width // edge, edge)
    count = edge * edge
    shift = count.bit_length() - 1
    red_blue = jnp.sum(blocks & _RED_BLUE, axis=(1, 3), dtype=jnp.uint32)
    green = jnp.sum((blocks & _GREEN) >> 8, axis=(1, 3), dtype=jnp.uint32)
    red_blue = ((red_blue + jnp.uint32(0x00010001 * (count // 2))) >> shift) & _RED_BLUE
    green = ((green + jnp.uint32(count // 2)) >> shift) << 8
    return (blocks[:, edge // 2, :, edge // 2] & ~jnp.uint32(_COLOUR)) | red_blue | green


def blur(packed: jax.Array, share: jax.Array) -> jax.Array:
    """Mixes an image with itself blurred by 1-2-1 along both axes; edges repeat.

    Args:
      packed: `[H, W] uint32`.
      share: `[] float32`, weight of the blurred image, in 0..1.
    """
    colour = packed & _COLOUR
    soft = _soften(_soften(colour, 0), 1)
    weight = jnp.round(jnp.clip(share, 0.0, 1.0) * 256).astype(jnp.uint32)
    mixed = [
        ((((colour & mask) * (256 - weight)) + ((soft & mask) * weight)) >> 8) & mask
        for mask in (_RED_BLUE, _GREEN)
    ]
    return (packed & ~jnp.uint32(_COLOUR)) | mixed[0] | mixed[1]


def _soften(colour: jax.Array, axis: int) -> jax.Array:
    """`(before + 2 own + after) / 4` along an axis, of colours without a geom id."""
    size = colour.shape[axis]

    def part(start: int, stop: int) -> jax.Array:
        return jax.lax.slice_in_dim(colour, start, stop, axis=axis)

    before = jnp.concatenate([part(0, 1), part(0, size - 1)], axis=axis)
    after = jnp.concatenate([part(1, size), part(size - 1, size)], axis=axis)
    return _mean(_mean(before, after), colour)


def _mean(one: jax.Array, other: jax.Array) -> jax.Array:
    """The mean of each channel, rounded down."""
    return (one & other) + (((one ^ other) & 0x00FEFEFE) >> 1)
