"""Lambert's law: from the nearest surface to packed pixels."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp

from mjx_arm.render.algebra import greater, lesser
from mjx_arm.render.colour import Colour
from mjx_arm.render.packing import pack
from mjx_arm.render.surface import Surface


def shade(
    colour: Colour, cosines: Sequence[jax.Array], diffuse: Sequence[jax.Array], ambient: jax.Array
) -> jax.Array:
    """Lights a coloured surface.

    Args:
      colour: its own colour.
      cosines: per light, `[H, W] float32`, cosines of incidence, 0 in shadow.
      diffuse: per light, `[3] float32`, its colour.
      ambient: `[3] float32`, colour of the light that reaches everything.

    Returns:
      `[H, W] uint32`, packed pixels.
    """
    lit = []
    for channel, own in enumerate((colour.red, colour.green, colour.blue)):
        light = ambient[channel]
        for level, cosine in zip(diffuse, cosines, strict=True):
            light = light + level[channel] * cosine
        value = own * light + 0.5
        lit.append(lesser(value, jnp.full_like(value, 255.0)).astype(jnp.uint32))
    return pack(lit[0], lit[1], lit[2], colour.geom)


def incidence(surface: Surface, depth: jax.Array) -> list[jax.Array]:
    """Cosines of incidence per light, `[H, W] float32`, 0 where a surface faces away.

    Args:
      surface: the nearest surface.
      depth: `[H, W] float32`, its z-depth, m.
    """
    return [greater(lambert * depth, jnp.zeros_like(depth)) for lambert in surface.lambert]
