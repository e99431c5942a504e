"""Hard shadows of a directional light: is a body between a surface point and the light?

Points and bodies are transformed to light space, whose z axis points towards the light. There
every shadow ray is vertical: a body covers a point if the point is within the body's outline and
below the body. Points lie on surfaces, so "below" is tested against a height inside the body on
the same ray. This needs no bias, because a lit point is above the inside of its own body.

Like a primitive, every body has two functions: `*_outline` runs once per geom and frame, and
`*_covers` at every pixel. Planes cast no shadow: light reaches a surface behind one.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from mjx_arm.render.algebra import greater, lesser, matmul, matvec, perpendicular, root, sign
from mjx_arm.render.rays import Rays, View, affine

# Keeps slopes finite for faces along the light and for axes across it.
_TINY = 1e-5


class LightSpace(NamedTuple):
    """Axes along and across a light.

    Attributes:
      axes: `[3, 3] float32`, the axes in rows, in the world.
      origin: `[3] float32`, its origin in the world, m.
    """

    axes: jax.Array
    origin: jax.Array


class Points(NamedTuple):
    """Surface points in light space: x, y and z, each `[H, W] float32`, m."""

    x: jax.Array
    y: jax.Array
    z: jax.Array


class Disc(NamedTuple):
    """A sphere.

    Attributes:
      centre: `[3]`, m.
      radius2: `[]`, squared radius, m².
    """

    centre: jax.Array
    radius2: jax.Array


class Rod(NamedTuple):
    """All points within a radius of an axis.

    Attributes:
      along: `[3]`, form in (x, y) of the distance from the centre along the axis as seen from the
        light, m.
      across: `[3]`, form of the distance across it, m.
      slope: `[]`, rise of the axis per distance along it.
      middle: `[]`, height of the centre, m.
      half: `[]`, half length of the axis as seen from the light, m.
      radius2: `[]`, squared radius, m².
    """

    along: jax.Array
    across: jax.Array
    slope: jax.Array
    middle: jax.Array
    half: jax.Array
    radius2: jax.Array


class Span(NamedTuple):
    """The heights between two parallel planes.

    Attributes:
      middle: `[3]`, form in (x, y) of the height of the middle, m.
      half: `[]`, half of the height between them, m.
    """

    middle: jax.Array
    half: jax.Array


class Drum(NamedTuple):
    """A cylinder.

    Attributes:
      rod: its axis.
      steepness: `[]`, rise of the light per distance across the axis.
      caps: the space between its flat ends.
    """

    rod: Rod
    steepness: jax.Array
    caps: Span


def make_light_space(to_light: jax.Array, origin: jax.Array) -> LightSpace:
    """Returns the light space of the unit vector `to_light [3]`, with its origin at `origin`."""
    return LightSpace(jnp.concatenate([perpendicular(to_light), to_light[None]]), origin)


def surface_points(space: LightSpace, view: View, rays: Rays, depth: jax.Array) -> Points:
    """Returns the points at z-depth `depth [H, W]`, m; `space` and `view` share their origin."""
    forms = matmul(space.axes, view.basis)
    return Points(*(depth * affine(form, rays.u, rays.v) for form in forms))


def sphere_outline(size: jax.Array, xpos: jax.Array, xmat: jax.Array, space: LightSpace) -> Disc:
    """Outline of the sphere of radius `size[0]`."""
    del xmat
    return Disc(matvec(space.axes, xpos - space.origin), size[0] ** 2)


def capsule_outline(size: jax.Array, xpos: jax.Array, xmat: jax.Array, space: LightSpace) -> Rod:
    """Outline of the capsule of radius `size[0]` and half length `size[1]`."""
    return _rod(size, xpos, xmat, space)[0]


def cylinder_outline(size: jax.Array, xpos: jax.Array, xmat: jax.Array, space: LightSpace) -> Drum:
    """Outline of the cylinder of radius `size[0]` and half length `size[1]`."""
    rod, run = _rod(size, xpos, xmat, space)
    centre = matvec(space.axes, xpos - space.origin)
    return Drum(rod, 1 / run, _span(matvec(space.axes, xmat[:, 2]), centre, size[1]))


def box_outline(size: jax.Array, xpos: jax.Array, xmat: jax.Array, space: LightSpace) -> Span:
    """Outline of the box of half lengths `size`; a span with a leading axis of three."""
    centre = matvec(space.axes, xpos - space.origin)
    return jax.vmap(_span, in_axes=(1, None, 0))(matmul(space.axes, xmat), centre, size)


def _rod(
    size: jax.Array, xpos: jax.Array, xmat: jax.Array, space: LightSpace
) -> tuple[Rod, jax.Array]:
    centre = matvec(space.axes, xpos - space.origin)
    axis = matvec(space.axes, xmat[:, 2])
    run2 = jnp.sum(axis[:2] ** 2)
    upright = run2 < _TINY**2
    run = jnp.sqrt(jnp.where(upright, _TINY**2, run2))
    x, y = jnp.where(upright, jnp.array([1.0, 0.0], axis.dtype), axis[:2] / run)
    rod = Rod(
        along=jnp.stack([x, y, -x * centre[0] - y * centre[1]]),
        across=jnp.stack([-y, x, y * centre[0] - x * centre[1]]),
        slope=axis[2] / run,
        middle=centre[2],
        half=size[1] * run,
        radius2=size[0] ** 2,
    )
    return rod, run


def _span(normal: jax.Array, centre: jax.Array, half: jax.Array) -> Span:
    rise = jnp.where(jnp.abs(normal[2]) < _TINY, _TINY * sign(normal[2]), normal[2])
    x, y = -normal[0] / rise, -normal[1] / rise
    middle = jnp.stack([x, y, centre[2] - x * centre[0] - y * centre[1]])
    return Span(middle, half / jnp.abs(rise))


def sphere_covers(disc: Disc, points: Points) -> jax.Array:
    """Whether the sphere is between each point and the light, `[H, W]` bool."""
    x, y = points.x - disc.centre[0], points.y - disc.centre[1]
    return (x * x + y * y < disc.radius2) & (points.z < disc.centre[2])


def capsule_covers(rod: Rod, points: Points) -> jax.Array:
    """Whether the capsule is between each point and the light, `[H, W]` bool."""
    along = affine(rod.along, points.x, points.y)
    across = affine(rod.across, points.x, points.y)
    nearest = greater(lesser(along, rod.half), -rod.half)
    beyond = along - nearest
    inside = beyond * beyond + across * across < rod.radius2
    return inside & (points.z < rod.middle + rod.slope * nearest)


def cylinder_covers(drum: Drum, points: Points) -> jax.Array:
    """Whether the cylinder is between each point and the light, `[H, W]` bool."""
    along = affine(drum.rod.along, points.x, points.y)
    across = affine(drum.rod.across, points.x, points.y)
    chord2 = drum.rod.radius2 - across * across
    half = root(chord2) * drum.steepness
    middle = drum.rod.middle + drum.rod.slope * along
    low, high = _span_ends(drum.caps, points)
    low, high = greater(low, middle - half), lesser(high, middle + half)
    return (chord2 > 0) & _middle_covers(low, high, points)


def box_covers(spans: Span, points: Points) -> jax.Array:
    """Whether the box is between each point and the light, `[H, W]` bool."""
    ends = [_span_ends(Span(*span), points) for span in zip(*spans, strict=True)]
    low = greater(greater(ends[0][0], ends[1][0]), ends[2][0])
    high = lesser(lesser(ends[0][1], ends[1][1]), ends[2][1])
    return _middle_covers(low, high, points)


def _span_ends(span: Span, points: Points) -> tuple[jax.Array, jax.Array]:
    middle = affine(span.middle, points.x, points.y)
    return middle - span.half, middle + span.half


def _middle_covers(low: jax.Array, high: jax.Array, points: Points) -> jax.Array:
    return (low < high) & (2 * points.z < low + high)
