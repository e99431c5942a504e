"""The nearest surface at every pixel, before it is coloured and lit."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_arm.render import primitives, shadows
from mjx_arm.render.algebra import fence
from mjx_arm.render.geoms import GeomGroup
from mjx_arm.render.packing import NO_GEOM
from mjx_arm.render.primitives import Hit
from mjx_arm.render.rays import Rays, View

_CASTS: dict[str, tuple[Callable[..., Any], Callable[..., Hit]]] = {
    "plane": (primitives.plane_coefficients, primitives.plane_hit),
    "box": (primitives.box_coefficients, primitives.box_hit),
    "sphere": (primitives.sphere_coefficients, primitives.sphere_hit),
    "capsule": (primitives.capsule_coefficients, primitives.capsule_hit),
    "cylinder": (primitives.cylinder_coefficients, primitives.cylinder_hit),
}

_SHADOWS: dict[str, tuple[Callable[..., Any], Callable[..., jax.Array]]] = {
    "box": (shadows.box_outline, shadows.box_covers),
    "sphere": (shadows.sphere_outline, shadows.sphere_covers),
    "capsule": (shadows.capsule_outline, shadows.capsule_covers),
    "cylinder": (shadows.cylinder_outline, shadows.cylinder_covers),
}


class Surface(NamedTuple):
    """What is nearest at each pixel.

    Attributes:
      w: `[H, W] float32`, inverse depth, 1/m; 0 where nothing is hit.
      lambert: per light, `[H, W] float32`, `w` times the cosine of incidence, 1/m.
      unlit: `[H, W] uint32`, the packed pixel in the geom's own colour.
    """

    w: jax.Array
    lambert: tuple[jax.Array, ...]
    unlit: jax.Array


class Setting(NamedTuple):
    """Camera, lights, sizes and colours of a frame.

    Attributes:
      view: the camera.
      rays: its rays.
      lights: `[L, 3] float32`, unit vectors towards the lights.
      sizes: `[ngeom, 3] float32`, as `geom_size` of the model, m.
      unlit: `[ngeom] uint32`, packed pixel of each geom in its own colour.
      shown: `[ngeom] bool`, whether each geom is shown; None if all are.
      varies: whether camera or lights differ from frame to frame.
    """

    view: View
    rays: Rays
    lights: jax.Array
    sizes: jax.Array | np.ndarray
    unlit: jax.Array
    shown: jax.Array | None
    varies: bool


class GeomPoses(NamedTuple):
    """Poses of all geoms: `xpos [ngeom, 3] float32`, m, and `xmat [ngeom, 3, 3] float32`."""

    xpos: jax.Array
    xmat: jax.Array


def empty_surface(setting: Setting) -> Surface:
    """The surface of a scene without geoms."""
    nothing = jnp.zeros_like(setting.rays.norm2)
    unlit = jnp.full(nothing.shape, NO_GEOM << 24, jnp.uint32)
    return Surface(nothing, tuple(nothing for _ in setting.rays.to_light), unlit)


def cast(
    groups: Sequence[GeomGroup], poses: GeomPoses, setting: Setting, surface: Surface
) -> Surface:
    """Returns the surface with the geoms of `groups` added where they are nearer."""

    def prepare(kind: str, size: jax.Array, xpos: jax.Array, xmat: jax.Array) -> Any:
        sight = primitives.make_sight(xpos, xmat, setting.view, setting.lights)
        return _CASTS[kind][0](size, sight)

    for group in groups:
        for geom, coefficients in zip(
            group.ids, _each(prepare, group, poses, setting), strict=True
        ):
            hit = _CASTS[group.kind][1](coefficients, setting.rays)
            if setting.shown is not None:
                hit = hit._replace(hit=hit.hit & setting.shown[geom])
            surface = _nearer(surface, hit, setting.unlit[geom])
    return surface


def covered(
    groups: Sequence[GeomGroup],
    poses: GeomPoses,
    setting: Setting,
    depth: jax.Array,
    light: int,
) -> jax.Array:
    """Whether any geom is between a pixel's surface and a light, `[H, W] bool`.

    Args:
      groups: the geoms that cast shadows; planes among them do not.
      poses: poses of all geoms.
      setting: camera and lights.
      depth: `[H, W] float32`, z-depth of the surface, m.
      light: index of the light in `setting`.
    """
    space = shadows.make_light_space(setting.lights[light], setting.view.origin)
    points = shadows.surface_points(space, setting.view, setting.rays, depth)

    def prepare(kind: str, size: jax.Array, xpos: jax.Array, xmat: jax.Array) -> Any:
        return _SHADOWS[kind][0](size, xpos, xmat, space)

    result = jnp.zeros(depth.shape, bool)
    for group in groups:
        if group.kind in _SHADOWS:
            outlines = _each(prepare, group, poses, setting)
            for geom, outline in zip(group.ids, outlines, strict=True):
                covers = _SHADOWS[group.kind][1](outline, points)
                if setting.shown is not None:
                    covers = covers & setting.shown[geom]
                result = result | covers
    return result


def _each(
    prepare: Callable[..., Any], group: GeomGroup, poses: GeomPoses, setting: Setting
) -> list[Any]:
    """What `prepare` returns for each geom of a group, computed for all of them at once."""
    prepared = jax.vmap(lambda *geom: prepare(group.kind, *geom))(
        jnp.asarray(setting.sizes[group.ids]), poses.xpos[group.ids], poses.xmat[group.ids]
    )
    prepared = fence(prepared) if setting.varies else prepared
    return [jax.tree.map(lambda leaf, i=i: leaf[i], prepared) for i in range(len(group.ids))]


def _nearer(surface: Surface, hit: Hit, unlit: jax.Array) -> Surface:
    closer = hit.hit & (hit.w > surface.w)
    lambert = zip(hit.lambert, surface.lambert, strict=True)
    return Surface(
        w=jnp.where(closer, hit.w, surface.w),
        lambert=tuple(jnp.where(closer, new, old) for new, old in lambert),
        unlit=jnp.where(closer, unlit, surface.unlit),
    )
