"""The rays through the pixels of an image, and affine functions of their screen coordinates.

A pixel has screen coordinates (u, v) in -1..1, u to the right and v upwards, and its ray is
`origin + t * (u * right + v * up + forward)` with `forward` of unit length along the optical
axis. So `t` is the z-depth, and every linear function of the ray's direction is affine in (u, v):
a *form* `[3] float32` stands for `form[0] * u + form[1] * v + form[2]`.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_arm.render.algebra import matmul


class View(NamedTuple):
    """A pinhole camera.

    Attributes:
      origin: `[3] float32`, its position in the world, m.
      basis: `[3, 3] float32`, columns `right`, `up` and `forward` in the world.
    """

    origin: jax.Array
    basis: jax.Array


class Rays(NamedTuple):
    """What is the same for all geoms at each pixel.

    Attributes:
      u: `[1, W] float32`.
      v: `[H, 1] float32`.
      norm2: `[H, W] float32`, squared length of the ray's direction.
      to_light: per light, `[H, W] float32`, dot product of the ray's direction and the unit vector
        towards the light.
    """

    u: jax.Array
    v: jax.Array
    norm2: jax.Array
    to_light: tuple[jax.Array, ...]


def make_view(pos: jax.Array, mat: jax.Array, fovy: jax.Array, aspect: float) -> View:
    """Returns the view of a MuJoCo camera.

    Args:
      pos: `[3] float32`, m.
      mat: `[3, 3] float32`, the camera's axes in columns: x right, y up, looking along -z.
      fovy: `[] float32`, vertical field of view, degrees.
      aspect: width over height.
    """
    half_height = jnp.tan(jnp.deg2rad(fovy) / 2)
    scale = jnp.stack([half_height * aspect, half_height, jnp.full_like(half_height, -1.0)])
    return View(pos, mat * scale)


def make_rays(view: View, lights: jax.Array, size: tuple[int, int]) -> Rays:
    """Returns the rays through the centres of `size` = (H, W) pixels.

    Args:
      view: the camera.
      lights: `[L, 3] float32`, unit vectors towards the lights.
      size: height and width.
    """
    height, width = size
    u = jnp.asarray((2 * np.arange(width) + 1) / width - 1, jnp.float32)[None, :]
    v = jnp.asarray(1 - (2 * np.arange(height) + 1) / height, jnp.float32)[:, None]
    right2, up2, _ = jnp.sum(view.basis**2, axis=0)
    norm2 = right2 * u * u + (up2 * v * v + 1)
    forms = matmul(lights, view.basis)
    return Rays(u, v, norm2, tuple(affine(form, u, v) for form in forms))


def affine(form: jax.Array, x: jax.Array, y: jax.Array) -> jax.Array:
    """Returns `form[0] * x + form[1] * y + form[2]`, for a form `[3] float32`."""
    return form[0] * x + (form[1] * y + form[2])
