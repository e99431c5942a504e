"""Casting rays at one plane, box, sphere, capsule or cylinder.

Every primitive has two functions. `*_coefficients` runs once per geom and frame: it reduces the
geom, the camera and the lights to a few scalars. `*_hit` runs at every pixel: it needs a few
multiply-adds on those scalars.

Distances are inverse depths: `w` is 1 / z-depth, in 1/m, and the nearest surface has the largest.
From a fixed origin the plane of a face is crossed at a `w` that is affine in the screen
coordinates, and a quadric at one that is affine plus the root of a quadratic. A convex body is hit
where the last entry into its faces comes before the first exit: where the smallest `w` among the
entries is at least the largest among the exits. A `w` that is not positive is behind the camera.
It needs no test here, because an empty pixel has `w = 0` and the larger `w` wins.

Shading is carried as `lambert`, which is `w` times the cosine of incidence. It is affine in `w` and
the screen coordinates, so there is no division until the nearest geom is known.

A geom around the camera and a plane seen from behind are not rendered, as with OpenGL's back-face
culling.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from mjx_arm.render.algebra import greater, lesser, matmul, matvec, perpendicular, root, sign
from mjx_arm.render.rays import Rays, View, affine

# Keeps reciprocals finite while the camera passes through a face, m.
_TINY = 1e-7
# Stands for "no constraint" among inverse depths, 1/m.
_HUGE = 1e9


class Hit(NamedTuple):
    """Where rays meet a primitive.

    Attributes:
      hit: `[H, W] bool`, whether the line of the ray enters the primitive; the others are
        meaningless where it is not set.
      w: `[H, W] float32`, inverse depth, 1/m; not positive where that is behind the camera.
      lambert: per light, `[H, W] float32`, `w` times the cosine of incidence, 1/m.
    """

    hit: jax.Array
    w: jax.Array
    lambert: tuple[jax.Array, ...]


class Sight(NamedTuple):
    """Camera and lights in the axes of a geom.

    Attributes:
      origin: `[3] float32`, position of the camera, m.
      basis: `[3, 3] float32`, the basis of the view.
      lights: `[L, 3] float32`, unit vectors towards the lights.
    """

    origin: jax.Array
    basis: jax.Array
    lights: jax.Array


def make_sight(xpos: jax.Array, xmat: jax.Array, view: View, lights: jax.Array) -> Sight:
    """Turns the view and `lights [L, 3]` into the axes of the geom at `xpos [3]`, `xmat [3, 3]`."""
    origin = matvec(xmat.T, view.origin - xpos)
    return Sight(origin, matmul(xmat.T, view.basis), matmul(lights, xmat))


class Slab(NamedTuple):
    """The space between two parallel faces.

    Attributes:
      near: `[3]`, form of `w` at the face on the camera's side.
      ratio: `[]`, `w` at the other face over that at the near one.
      inside: `[]`, huge where the camera is between the faces, else minus huge.
    """

    near: jax.Array
    ratio: jax.Array
    inside: jax.Array


def _make_slab(origin: jax.Array, form: jax.Array, half: jax.Array) -> Slab:
    """The slab `|x| <= half` for a camera at `x = origin` and rays of direction `form`."""
    gap = jnp.abs(origin) - half
    gap = jnp.where(jnp.abs(gap) < _TINY, _TINY, gap)
    return Slab(-sign(origin) * form / gap, gap / (jnp.abs(origin) + half), -sign(gap) * _HUGE)


def _never(slab: Slab, condition: jax.Array) -> Slab:
    """Returns the slab, but entered only behind the camera if the condition holds."""
    behind = jnp.zeros_like(slab.near).at[..., 2].set(-1.0)
    return Slab(
        jnp.where(condition, behind, slab.near),
        slab.ratio,
        jnp.where(condition, -_HUGE, slab.inside),
    )


def _slab_ends(slab: Slab, rays: Rays) -> tuple[jax.Array, jax.Array]:
    """Inverse depths of entry and exit, each `[H, W]`."""
    near = affine(slab.near, rays.u, rays.v)
    far = near * slab.ratio
    # From inside there is no entry, and either face may be the exit.
    return greater(near, slab.inside), greater(far, lesser(near, slab.inside))


class Plane(NamedTuple):
    """A rectangle or a whole plane, seen from the front.

    Attributes:
      w: `[3]`, form of the inverse depth.
      offset: `[2, 3]`, forms of the hit's local x and y, times `w`.
      half: `[2]`, half lengths along x and y, m.
      cosine: `[L]`, cosines of incidence.
    """

    w: jax.Array
    offset: jax.Array
    half: jax.Array
    cosine: jax.Array


def plane_coefficients(size: jax.Array, sight: Sight) -> Plane:
    """Prepares the plane z = 0 with half lengths `size[:2]`, m; 0 stands for infinite."""
    height = sight.origin[2]
    in_front = height > _TINY
    behind = jnp.zeros_like(sight.basis[2]).at[2].set(-1.0)
    w = jnp.where(in_front, -sight.basis[2] / jnp.where(in_front, height, 1.0), behind)
    offset = sight.origin[:2, None] * w + sight.basis[:2]
    return Plane(w, offset, jnp.where(size[:2] > 0, size[:2], _HUGE), sight.lights[:, 2])


def plane_hit(plane: Plane, rays: Rays) -> Hit:
    """Casts the rays at a plane."""
    w = affine(plane.w, rays.u, rays.v)
    x, y = (affine(form, rays.u, rays.v) for form in plane.offset)
    hit = (jnp.abs(x) <= plane.half[0] * w) & (jnp.abs(y) <= plane.half[1] * w)
    return Hit(hit, w, tuple(w * cosine for cosine in plane.cosine))


class Box(NamedTuple):
    """A box.

    Attributes:
      slabs: its three slabs, each field with a leading axis of three.
      cosine: `[3, L]`, cosines of incidence at the faces on the camera's side.
    """

    slabs: Slab
    cosine: jax.Array


def box_coefficients(size: jax.Array, sight: Sight) -> Box:
    """Prepares the box with half lengths `size`, m."""
    slabs = jax.vmap(_make_slab)(sight.origin, sight.basis, size)
    around = jnp.all(slabs.inside > 0)
    slabs = jax.vmap(_never, in_axes=(0, None))(slabs, around)
    return Box(slabs, sign(sight.origin)[:, None] * sight.lights.T)


def box_hit(box: Box, rays: Rays) -> Hit:
    """Casts the rays at a box."""
    w, leave = _slab_ends(Slab(*(field[0] for field in box.slabs)), rays)
    cosines = [jnp.broadcast_to(cosine, w.shape) for cosine in box.cosine[0]]
    for axis in (1, 2):
        enter_axis, leave_axis = _slab_ends(Slab(*(field[axis] for field in box.slabs)), rays)
        later = enter_axis < w
        w = jnp.where(later, enter_axis, w)
        leave = greater(leave, leave_axis)
        faces = zip(box.cosine[axis], cosines, strict=True)
        cosines = [jnp.where(later, this, other) for this, other in faces]
    return Hit(w >= leave, w, tuple(w * cosine for cosine in cosines))


class Sphere(NamedTuple):
    """A sphere, hit at `towards + sqrt((shrink * towards)² - across[0]² - across[1]²)`.

    Attributes:
      towards: `[3]`, form of the direction towards the centre.
      across: `[2, 3]`, forms of the directions across.
      shrink: `[]`, radius over distance.
      offset: `[L]`, the camera's offset from the centre along the lights, over the radius.
      curvature: `[]`, 1 / radius, 1/m.
    """

    towards: jax.Array
    across: jax.Array
    shrink: jax.Array
    offset: jax.Array
    curvature: jax.Array


def sphere_coefficients(size: jax.Array, sight: Sight) -> Sphere:
    """Prepares the sphere of radius `size[0]`, m."""
    radius = size[0]
    distance2 = jnp.sum(sight.origin**2)
    power = distance2 - radius**2
    outside = power > 0
    power = jnp.where(outside, power, 1.0)
    distance = jnp.sqrt(jnp.where(outside, distance2, 1.0))
    # In axes along and across the line to the centre the discriminant loses no digits.
    axis = -sight.origin / distance
    towards = matvec(sight.basis.T, axis) * distance / power
    return Sphere(
        towards=jnp.where(outside, towards, jnp.zeros_like(towards).at[2].set(-1.0)),
        across=matmul(perpendicular(axis), sight.basis) / jnp.sqrt(power),
        # From inside no ray meets it.
        shrink=jnp.where(outside, radius / distance, 0.0),
        offset=matvec(sight.lights, sight.origin) / radius,
        curvature=1 / radius,
    )


def sphere_hit(sphere: Sphere, rays: Rays) -> Hit:
    """Casts the rays at a sphere."""
    towards = affine(sphere.towards, rays.u, rays.v)
    first, second = (affine(form, rays.u, rays.v) for form in sphere.across)
    inward = sphere.shrink * towards
    root2 = inward * inward - first * first - second * second
    w = towards + root(root2)
    lambert = tuple(
        offset * w + sphere.curvature * direction
        for offset, direction in zip(sphere.offset, rays.to_light, strict=True)
    )
    return Hit(root2 >= 0, w, lambert)


class Tube(NamedTuple):
    """The infinite cylinder about z.

    Attributes:
      away: `[3]`, form of the direction away from the axis.
      across: `[3]`, form of the direction across that and the axis.
      distance: `[]`, distance of the camera from the axis, m.
      radius2: `[]`, squared radius, m².
      power: `[]`, squared distance minus squared radius, m²; negative inside.
      inverse_power: `[]`, 1/m².
    """

    away: jax.Array
    across: jax.Array
    distance: jax.Array
    radius2: jax.Array
    power: jax.Array
    inverse_power: jax.Array


def _make_tube(radius: jax.Array, sight: Sight) -> Tube:
    x, y = sight.origin[:2]
    distance2 = x * x + y * y
    on_axis = distance2 < _TINY**2
    distance = jnp.sqrt(jnp.where(on_axis, 1.0, distance2))
    x, y = jnp.where(on_axis, 1.0, x / distance), jnp.where(on_axis, 0.0, y / distance)
    power = distance2 - radius**2
    power = jnp.where(jnp.abs(power) < _TINY * radius, _TINY * radius, power)
    return Tube(
        away=x * sight.basis[0] + y * sight.basis[1],
        across=x * sight.basis[1] - y * sight.basis[0],
        distance=jnp.where(on_axis, 0.0, distance),
        radius2=radius**2,
        power=power,
        inverse_power=1 / power,
    )


class _TubeHit(NamedTuple):
    """Entry into a tube, each `[H, W]`: square of the root, `w`, and the tube's two forms.

    From inside `w` is negative, so that no ray is taken to enter.
    """

    root2: jax.Array
    w: jax.Array
    away: jax.Array
    across2: jax.Array


def _enter_tube(tube: Tube, rays: Rays) -> _TubeHit:
    away = affine(tube.away, rays.u, rays.v)
    across = affine(tube.across, rays.u, rays.v)
    across2 = across * across
    root2 = tube.radius2 * (away * away) - tube.power * across2
    w = (root(root2) - tube.distance * away) * tube.inverse_power
    return _TubeHit(root2, w, away, across2)


class Cylinder(NamedTuple):
    """A tube with flat caps.

    Attributes:
      tube: the side.
      axial: `[3]`, form of the direction along the axis.
      height: `[]`, the camera's height along the axis, m.
      half: `[]`, half length, m.
      cap: `[]`, `w` at the cap on the camera's side over `axial`, 1/m; 0 where it sees no cap.
      offset: `[L]`, the camera's offset from the axis along the lights, over the radius.
      direction: `[L, 3]`, forms of the direction off the axis along the lights, over the radius.
      cosine: `[L]`, cosines of incidence at that cap.
    """

    tube: Tube
    axial: jax.Array
    height: jax.Array
    half: jax.Array
    cap: jax.Array
    offset: jax.Array
    direction: jax.Array
    cosine: jax.Array


def cylinder_coefficients(size: jax.Array, sight: Sight) -> Cylinder:
    """Prepares the cylinder of radius `size[0]` and half length `size[1]`, m."""
    radius, half = size[0], size[1]
    tube = _make_tube(radius, sight)
    height = sight.origin[2]
    gap = jnp.abs(height) - half
    return Cylinder(
        tube=tube,
        axial=sight.basis[2],
        height=height,
        half=half,
        cap=jnp.where(gap > _TINY, -sign(height) / greater(gap, jnp.full_like(gap, _TINY)), 0.0),
        offset=matvec(sight.lights[:, :2], sight.origin[:2]) / radius,
        direction=matmul(sight.lights[:, :2], sight.basis[:2]) / radius,
        cosine=sign(height) * sight.lights[:, 2],
    )


def cylinder_hit(cylinder: Cylinder, rays: Rays) -> Hit:
    """Casts the rays at a cylinder."""
    tube = cylinder.tube
    side = _enter_tube(tube, rays)
    axial = affine(cylinder.axial, rays.u, rays.v)
    rise = cylinder.height * side.w + axial
    on_side = (side.root2 >= 0) & (jnp.abs(rise) <= cylinder.half * side.w)
    w_cap = cylinder.cap * axial
    run = tube.distance * w_cap + side.away
    on_cap = run * run + side.across2 <= tube.radius2 * (w_cap * w_cap)
    w = jnp.where(on_cap, w_cap, side.w)
    shading = zip(cylinder.offset, cylinder.direction, cylinder.cosine, strict=True)
    lambert = tuple(
        jnp.where(on_cap, cosine * w, offset * w + affine(form, rays.u, rays.v))
        for offset, form, cosine in shading
    )
    return Hit(on_cap | on_side, w, lambert)


class Capsule(NamedTuple):
    """A tube between two half spheres.

    A ray that enters a capsule through an end enters its tube beyond that end. So the height at
    which it enters the tube decides which of the two spheres is tested.

    Attributes:
      tube: the side.
      axial: `[3]`, form of the direction along the axis.
      height: `[]`, the camera's height along the axis, m.
      half: `[]`, half length of the straight part, m.
      beyond: `[]`, added to the tube's height to choose the end: 0, or plus or minus huge where
        the camera is inside the tube and sees only the end on its own side.
      towards: `[3]`, form of the direction along the offset to the centre, m.
      power: `[2]`, squared lengths of the tangents to the ends at +half and -half, m².
      inverse_power: `[2]`, 1/m².
      offset: `[L]`, the camera's offset from the centre along the lights, over the radius.
      curvature: `[]`, 1 / radius, 1/m.
      tilt: `[L]`, the axis along the lights, over the radius, 1/m.
    """

    tube: Tube
    axial: jax.Array
    height: jax.Array
    half: jax.Array
    beyond: jax.Array
    towards: jax.Array
    power: jax.Array
    inverse_power: jax.Array
    offset: jax.Array
    curvature: jax.Array
    tilt: jax.Array


def capsule_coefficients(size: jax.Array, sight: Sight) -> Capsule:
    """Prepares the capsule of radius `size[0]` and half length `size[1]`, m."""
    radius, half = size[0], size[1]
    tube = _make_tube(radius, sight)
    outside = tube.power > 0
    height = sight.origin[2]
    rise = height - jnp.stack([half, -half])
    power = sight.origin[0] ** 2 + sight.origin[1] ** 2 + rise**2 - radius**2
    around = ~outside & ((jnp.abs(height) <= half) | jnp.any(power <= 0))
    # Such a sphere is out of the reach of any ray.
    power = jnp.where(around, _HUGE, greater(power, _TINY * radius))
    return Capsule(
        tube=tube,
        axial=sight.basis[2],
        height=height,
        half=half,
        beyond=jnp.where(outside, 0.0, sign(height) * _HUGE),
        towards=jnp.where(around, 0.0, -matvec(sight.basis.T, sight.origin)),
        power=power,
        inverse_power=1 / power,
        offset=matvec(sight.lights, sight.origin) / radius,
        curvature=1 / radius,
        tilt=sight.lights[:, 2] / radius,
    )


def capsule_hit(capsule: Capsule, rays: Rays) -> Hit:
    """Casts the rays at a capsule."""
    side = _enter_tube(capsule.tube, rays)
    axial = affine(capsule.axial, rays.u, rays.v)
    rise = capsule.height * side.w + axial
    on_side = jnp.abs(rise) <= capsule.half * side.w
    w_end, end_root2 = _capsule_end(capsule, rise + capsule.beyond > 0, axial, rays)
    w = jnp.where(on_side, side.w, w_end)
    hit = (side.root2 >= 0) & (on_side | (end_root2 >= 0))
    # The normal points away from the nearest point of the axis.
    limit = capsule.half * w
    nearest = greater(lesser(capsule.height * w + axial, limit), -limit)
    shading = zip(capsule.offset, capsule.tilt, rays.to_light, strict=True)
    lambert = tuple(
        offset * w + capsule.curvature * direction - tilt * nearest
        for offset, tilt, direction in shading
    )
    return Hit(hit, w, lambert)


def _capsule_end(
    capsule: Capsule, upper: jax.Array, axial: jax.Array, rays: Rays
) -> tuple[jax.Array, jax.Array]:
    """Inverse depth at the sphere of the upper or lower end, and the square of its root."""
    half = jnp.where(upper, capsule.half, -capsule.half)
    power = jnp.where(upper, capsule.power[0], capsule.power[1])
    inverse_power = jnp.where(upper, capsule.inverse_power[0], capsule.inverse_power[1])
    towards = affine(capsule.towards, rays.u, rays.v) + half * axial
    root2 = towards * towards - rays.norm2 * power
    return (towards + root(root2)) * inverse_power, root2
