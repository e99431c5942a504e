"""The surface's own colour at every pixel: the stage between casting and shading.

A stage is a function of the type `ColourStage`. The plain one returns the colours of the geoms,
which casting has carried along. A texture would be another stage, which looks its colour up at the
point that it computes from the depth, the rays and the pose of the geom.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp

from mjx_arm.render.packing import unpack
from mjx_arm.render.surface import GeomPoses, Setting, Surface


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


ColourStage: TypeAlias = Callable[[Surface, jax.Array, Setting, GeomPoses], Colour]
"""`(surface, depth, setting, poses) -> Colour`; depth is `[H, W] float32`, z-depth in m."""


def geom_colour(surface: Surface, depth: jax.Array, setting: Setting, poses: GeomPoses) -> Colour:
    """Returns the colour of the geom at each pixel."""
    del depth, setting, poses
    *channels, geom = unpack(surface.unlit)
    red, green, blue = (channel.astype(jnp.float32) for channel in channels)
    return Colour(red, green, blue, geom)
