"""The packed pixel: red, green and blue in the low three bytes, the geom id in the top one."""

from __future__ import annotations

import jax
import jax.numpy as jnp

NO_GEOM = 255


def pack(red: jax.Array, green: jax.Array, blue: jax.Array, geom: jax.Array) -> jax.Array:
    """Packs byte values, each `[...] uint32`, into pixels, `[...] uint32`."""
    return red | (green << 8) | (blue << 16) | (geom << 24)


def unpack(packed: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Unpacks pixels into red, green, blue and geom id, each `[...] uint32`."""
    return packed & 255, (packed >> 8) & 255, (packed >> 16) & 255, packed >> 24


def rgb(packed: jax.Array) -> jax.Array:
    """Returns the colours of packed pixels `[...] uint32` as `[..., 3] uint8`."""
    red, green, blue, _ = unpack(packed)
    return jnp.stack([red, green, blue], axis=-1).astype(jnp.uint8)


def segmentation(packed: jax.Array) -> jax.Array:
    """Returns the geom ids of packed pixels `[...] uint32`, `[...] int32`; -1 for no geom."""
    geom = (packed >> 24).astype(jnp.int32)
    return jnp.where(geom == NO_GEOM, -1, geom)
