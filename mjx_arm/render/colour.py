"""The surface's own colour at every pixel: the stage between casting and shading.

Casting has carried the colours of the geoms along. Textures multiply them; see `texture.py`.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from mjx_arm.render.packing import unpack
from mjx_arm.render.surface import Surface


class Colour(NamedTuple):
    """Colour of the nearest surface before it is lit.

    Attributes:
      red: `[H, W] float32`, in 0..255, as the next two.
      green: `[H, W] float32`.
      blue: `[H, W] float32`.
      geom: `[H, W] uint32`, id of the geom, `NO_GEOM` where nothing is hit.
    """

    red: jax.Array
    green: jax.Array
    blue: jax.Array
    geom: jax.Array


def geom_colour(surface: Surface) -> Colour:
    """Returns the colour of the geom at each pixel."""
    *channels, geom = unpack(surface.unlit)
    red, green, blue = (channel.astype(jnp.float32) for channel in channels)
    return Colour(red, green, blue, geom)
