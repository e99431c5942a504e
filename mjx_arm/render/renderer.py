"""The maker of renderers: from the poses of the geoms to an image."""

from __future__ import annotations

import dataclasses
import functools
from typing import TYPE_CHECKING, Literal, Protocol, overload

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.typing import ArrayLike

from mjx_arm.render.appearance import (
    Appearance,
    default_appearance,
    headlight_diffuse,
    light_casts_shadow,
)
from mjx_arm.render.geoms import (
    GeomGroup,
    geom_groups,
    static_geoms,
    validate_geoms,
    visible_geoms,
)
from mjx_arm.render.materialize import materialize
from mjx_arm.render.packing import pack
from mjx_arm.render.rays import make_rays, make_view
from mjx_arm.render.shading import incidence, shade
from mjx_arm.render.surface import Poses, Setting, Surface, cast, covered, empty_surface

if TYPE_CHECKING:
    from mjx_arm.scene import Scene


class Render(Protocol):
    """Draws packed pixels, `[H, W] uint32`; see `make_renderer`."""

    def __call__(
        self, geom_xpos: ArrayLike, geom_xmat: ArrayLike, appearance: Appearance | None = None
    ) -> jax.Array:
        """Draws one frame."""
        ...


class RenderWithDepth(Protocol):
    """Draws packed pixels, `[H, W] uint32`, and z-depth, `[H, W] float32` in m."""

    def __call__(
        self, geom_xpos: ArrayLike, geom_xmat: ArrayLike, appearance: Appearance | None = None
    ) -> tuple[jax.Array, jax.Array]:
        """Draws one frame."""
        ...


@overload
def make_renderer(
    scene: Scene,
    *,
    camera: str = ...,
    size: tuple[int, int] = ...,
    shadows: bool = ...,
    depth: Literal[False] = ...,
) -> Render: ...


@overload
def make_renderer(
    scene: Scene,
    *,
    camera: str = ...,
    size: tuple[int, int] = ...,
    shadows: bool = ...,
    depth: Literal[True],
) -> RenderWithDepth: ...


@overload
def make_renderer(
    scene: Scene,
    *,
    camera: str = ...,
    size: tuple[int, int] = ...,
    shadows: bool = ...,
    depth: bool = ...,
) -> Render | RenderWithDepth: ...


def make_renderer(
    scene: Scene,
    *,
    camera: str = "front",
    size: tuple[int, int] = (64, 64),
    shadows: bool = False,
    depth: bool = False,
) -> Render | RenderWithDepth:
    """Makes `render(geom_xpos, geom_xmat, appearance=None)`, which draws one frame of a scene.

    The function is jitted, and may be vmapped any number of times. It takes the poses of
    all geoms in the order of the model: `geom_xpos [ngeom, 3]`, m, and `geom_xmat [ngeom, 3, 3]`
    or `[ngeom, 9]`; those of geoms welded to the world are ignored, since they are known. It
    returns packed pixels, `[H, W] uint32`: see `rgb` and `segmentation`.

    Without `appearance` the camera, light and colours are the model's, and everything that is
    welded to the world has been cast beforehand. With an `Appearance`, traced or not, everything
    is cast anew; start from `default_appearance`.

    What is drawn follows MuJoCo's own renderer: geoms of group 0, 1 and 2 with alpha above zero,
    all opaque; ambient plus one directional light, and the headlight's diffuse part where the
    model has one; black where nothing is hit. Not drawn are specular light, emission, reflections,
    the skybox, geoms around the camera, and planes from behind. A shadow takes away the diffuse
    part of the directional light. There is no near or far clipping.

    Args:
      scene: only its `mj_model` is read.
      camera: name of a camera that is fixed to the world.
      size: height and width of the image, pixels.
      shadows: whether the directional light casts hard shadows.
      depth: whether to return a second array: z-depth along the optical axis, `[H, W] float32`,
        m, infinite where nothing is hit.

    Raises:
      ValueError: an argument does not fit, or the model holds a geom, camera or light that cannot
        be drawn.
    """
    _validate_size(size)
    validate_geoms(scene.mj_model)
    with jax.ensure_compile_time_eval():
        own = default_appearance(scene, camera)
        plan = _make_plan(scene.mj_model, size, shadows)
    cast_background = jax.jit(functools.partial(_background, plan)).lower(own).compile()
    with jax.ensure_compile_time_eval():
        background = cast_background(own)
    draw = _packed_and_depth if depth else _packed
    return jax.jit(functools.partial(draw, plan, own, background))


@dataclasses.dataclass(frozen=True)
class _Plan:
    """What is settled when a renderer is made.

    Attributes:
      size: height and width, pixels.
      ngeom: number of geoms in the model.
      still: visible geoms that are welded to the world.
      still_poses: poses of all geoms, right for those.
      moving: the other visible geoms.
      headlight: `[3] float32`, diffuse colour of the light along the camera's axis, or None.
      shadows: whether the first light casts shadows.
    """

    size: tuple[int, int]
    ngeom: int
    still: list[GeomGroup]
    still_poses: Poses
    moving: list[GeomGroup]
    headlight: np.ndarray | None
    shadows: bool


def _make_plan(model: mujoco.MjModel, size: tuple[int, int], shadows: bool) -> _Plan:
    visible, static = visible_geoms(model), static_geoms(model)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return _Plan(
        size=size,
        ngeom=model.ngeom,
        still=geom_groups(model, visible & static),
        still_poses=_check_poses(data.geom_xpos, data.geom_xmat, model.ngeom),
        moving=geom_groups(model, visible & ~static),
        headlight=headlight_diffuse(model),
        shadows=shadows and light_casts_shadow(model),
    )


def _make_setting(plan: _Plan, appearance: Appearance) -> Setting:
    height, width = plan.size
    view = make_view(
        appearance.camera_pos, appearance.camera_mat, appearance.camera_fovy, width / height
    )
    to_light = -appearance.light_dir
    lights = [to_light / jnp.sqrt(jnp.sum(to_light**2))]
    if plan.headlight is not None:
        lights.append(-view.basis[:, 2])
    levels = jnp.round(jnp.clip(appearance.geom_rgb, 0, 1) * 255).astype(jnp.uint32)
    ids = jnp.arange(plan.ngeom, dtype=jnp.uint32)
    unlit = pack(levels[:, 0], levels[:, 1], levels[:, 2], ids)
    return Setting(view, make_rays(view, jnp.stack(lights), plan.size), jnp.stack(lights), unlit)


def _background(plan: _Plan, appearance: Appearance) -> Surface:
    setting = _make_setting(plan, appearance)
    return cast(plan.still, plan.still_poses, setting, empty_surface(setting))


def _draw(
    plan: _Plan,
    own: Appearance,
    background: Surface,
    geom_xpos: ArrayLike,
    geom_xmat: ArrayLike,
    appearance: Appearance | None,
) -> tuple[jax.Array, jax.Array]:
    """Packed pixels, and the z-depth of the nearest surface."""
    poses = _check_poses(geom_xpos, geom_xmat, plan.ngeom)
    look = own if appearance is None else appearance
    setting = _make_setting(plan, look)
    if appearance is not None:
        background = _background(plan, appearance)
    surface = cast(plan.moving, poses, setting, background)
    hit = surface.w > 0
    depth = 1 / jnp.where(hit, surface.w, jnp.ones_like(surface.w))
    cosines = incidence(surface, depth)
    if plan.shadows:
        dark = covered(plan.moving, poses, setting, depth)
        dark = dark | covered(plan.still, plan.still_poses, setting, depth)
        cosines[0] = jnp.where(dark, jnp.zeros_like(depth), cosines[0])
    diffuse = [look.light_diffuse]
    if plan.headlight is not None:
        diffuse.append(jnp.asarray(plan.headlight))
    packed = shade(surface, cosines, diffuse, look.ambient)
    return packed, jnp.where(hit, depth, jnp.inf)


def _packed(
    plan: _Plan,
    own: Appearance,
    background: Surface,
    geom_xpos: ArrayLike,
    geom_xmat: ArrayLike,
    appearance: Appearance | None = None,
) -> jax.Array:
    packed, _ = _draw(plan, own, background, geom_xpos, geom_xmat, appearance)
    return materialize(packed)[0]


def _packed_and_depth(
    plan: _Plan,
    own: Appearance,
    background: Surface,
    geom_xpos: ArrayLike,
    geom_xmat: ArrayLike,
    appearance: Appearance | None = None,
) -> tuple[jax.Array, jax.Array]:
    packed, depth = _draw(plan, own, background, geom_xpos, geom_xmat, appearance)
    packed, depth = materialize(packed, depth)
    return packed, depth


def _check_poses(geom_xpos: ArrayLike, geom_xmat: ArrayLike, ngeom: int) -> Poses:
    xpos, xmat = jnp.asarray(geom_xpos, jnp.float32), jnp.asarray(geom_xmat, jnp.float32)
    if xpos.shape != (ngeom, 3) or xmat.shape not in ((ngeom, 3, 3), (ngeom, 9)):
        raise ValueError(
            f"geom_xpos {list(xpos.shape)} and geom_xmat {list(xmat.shape)} must be [{ngeom}, 3] "
            f"and [{ngeom}, 3, 3], the poses of one frame; use jax.vmap for several"
        )
    return Poses(xpos, xmat.reshape(ngeom, 3, 3))


def _validate_size(size: object) -> None:
    if (
        not isinstance(size, (tuple, list))
        or len(size) != 2
        or not all(isinstance(length, int | np.integer) and length > 0 for length in size)
    ):
        raise ValueError(f"size={size!r} must be (height, width) in pixels, two positive integers")
