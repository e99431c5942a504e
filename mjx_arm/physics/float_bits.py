"""Float64 values as pairs of uint32 words, for jax's default of 32-bit types.

A cast to float32 would round a simulation's state at every iteration; the bits do not change.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

_EXPONENT_OFFSET = 1023 - 127


def float32_to_bits(value: jax.Array) -> jax.Array:
    """The float64 that equals a float32, as two words in little-endian order.

    Args:
      value: `[...] float32`. Subnormals become zero.

    Returns:
      `[..., 2] uint32`.
    """
    bits = jax.lax.bitcast_convert_type(value, jnp.uint32)
    sign = bits & jnp.uint32(0x80000000)
    exponent = (bits >> 23) & jnp.uint32(0xFF)
    mantissa = bits & jnp.uint32(0x7FFFFF)
    wide = jnp.where(exponent == 0xFF, jnp.uint32(0x7FF), exponent + jnp.uint32(_EXPONENT_OFFSET))
    normal = exponent != 0
    high = sign | jnp.where(normal, (wide << 20) | (mantissa >> 3), jnp.uint32(0))
    low = jnp.where(normal, mantissa << 29, jnp.uint32(0))
    return jnp.stack([low, high], axis=-1)


def float64_to_words(values: np.ndarray) -> np.ndarray:
    """A view of `[..., n] float64`, its last axis contiguous, as `[..., 2 n] uint32`."""
    return values.view(np.uint32)
