"""Images of a scene by ray casting, in pure JAX."""

from mjx_arm.render.packing import rgb, segmentation
from mjx_arm.render.renderer import make_renderer

__all__ = ["make_renderer", "rgb", "segmentation"]
