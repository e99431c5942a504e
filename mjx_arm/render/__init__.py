"""Images of a scene by ray casting, in pure JAX."""

from mjx_arm.render.appearance import Appearance, default_appearance
from mjx_arm.render.packing import rgb, segmentation
from mjx_arm.render.renderer import make_renderer

__all__ = ["Appearance", "default_appearance", "make_renderer", "rgb", "segmentation"]
