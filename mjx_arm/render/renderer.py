"""The maker of renderers: from the poses of the geoms to an image."""

from __future__ import annotations

import dataclasses
import functools
from typing import Literal, Protocol, overload

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.typing import ArrayLike

from mjx_arm.render.algebra import fence
from mjx_arm.render.colour import Colour, geom_colour
from mjx_arm.render.geoms import (
    GeomGroup,
    geom_groups,
    static_geoms,
    validate_geoms,
    visible_geoms,
)
from mjx_arm.render.look import (
    LOOK_FIELDS,
    CameraPose,
    Look,
    LookSpec,
    make_look,
    make_look_spec,
)
from mjx_arm.render.materialize import materialize
from mjx_arm.render.packing import pack
from mjx_arm.render.pixels import average
from mjx_arm.render.rays import make_rays, make_view
from mjx_arm.render.shading import incidence, shade
from mjx_arm.render.surface import (
    GeomPoses,
    Setting,
    Surface,
    cast,
    covered,
    empty_surface,
)
from mjx_arm.render.texture import (
    Atlas,
    Materials,
    Skin,
    apply_textures,
    look_up,
    make_atlas,
    make_skins,
)
from mjx_arm.varies import Params, Varies, check_params, check_varies, fill, own_params

# Fields that would change the image, but that the renderer takes from the model only.
_CONSTANT_FIELDS = ("mat_rgba", "cam_sensorsize", "cam_intrinsic")
_OTHER_FIELDS = ("geom_size", "light_shadow", "mat_texture", "mat_texrepeat")
# Rays through a pixel -> rays side by side in it.
_SAMPLES = {1: 1, 4: 2, 16: 4}


class HasModel(Protocol):
    """Anything with a MuJoCo model, such as a `Scene`."""

    @property
    def mj_model(self) -> mujoco.MjModel:
        """The model."""
        ...


class Render(Protocol):
    """Renders packed pixels, `[H, W] uint32`; see `make_renderer`."""

    def __call__(
        self,
        geom_xpos: ArrayLike,
        geom_xmat: ArrayLike,
        params: Params | None = None,
        camera_pose: CameraPose | None = None,
    ) -> jax.Array:
        """Renders one frame."""
        ...


class RenderWithDepth(Protocol):
    """Renders packed pixels, `[H, W] uint32`, and z-depth, `[H, W] float32` in m."""

    def __call__(
        self,
        geom_xpos: ArrayLike,
        geom_xmat: ArrayLike,
        params: Params | None = None,
        camera_pose: CameraPose | None = None,
    ) -> tuple[jax.Array, jax.Array]:
        """Renders one frame."""
        ...


@overload
def make_renderer(
    scene: HasModel | mujoco.MjModel,
    *,
    camera: str = ...,
    size: tuple[int, int] = ...,
    shadows: bool = ...,
    samples: int = ...,
    depth: Literal[False] = ...,
    varies: Varies | None = ...,
) -> Render: ...


@overload
def make_renderer(
    scene: HasModel | mujoco.MjModel,
    *,
    camera: str = ...,
    size: tuple[int, int] = ...,
    shadows: bool = ...,
    samples: int = ...,
    depth: Literal[True],
    varies: Varies | None = ...,
) -> RenderWithDepth: ...


@overload
def make_renderer(
    scene: HasModel | mujoco.MjModel,
    *,
    camera: str = ...,
    size: tuple[int, int] = ...,
    shadows: bool = ...,
    samples: int = ...,
    depth: bool = ...,
    varies: Varies | None = ...,
) -> Render | RenderWithDepth: ...


def make_renderer(
    scene: HasModel | mujoco.MjModel,
    *,
    camera: str = "front",
    size: tuple[int, int] = (64, 64),
    shadows: bool = False,
    samples: int = 1,
    depth: bool = False,
    varies: Varies | None = None,
) -> Render | RenderWithDepth:
    """Makes `render(geom_xpos, geom_xmat, params={}, camera_pose=None)` for frames of a scene.

    The function is jitted, and may be vmapped any number of times. Its arguments are

    - `geom_xpos [ngeom, 3]`, m, and `geom_xmat [ngeom, 3, 3]` or `[ngeom, 9]`: the poses of all
      geoms in the order of the model. Poses of geoms that are welded to the world are ignored,
      unless the pose, size or colour of the geom varies by episode.
    - `params`: the values of the rows in `varies`, of one episode.
    - `camera_pose`: position `[3]`, m, and axes in columns, `[3, 3]`, of the camera, as
      `mjx_arm.kinematics.make_camera_pose` computes them. A camera on a moving body needs it; for
      another camera it replaces the model's pose.

    It returns packed pixels, `[H, W] uint32`: see `rgb` and `segmentation`.

    What varies: of `varies` and `params` the renderer reads `geom_rgba`, `geom_size`, `light_dir`
    (any length but zero), `light_diffuse`, `light_ambient`, `light_shadow`, `cam_pos`, `cam_quat`,
    `cam_fovy`, `mat_texture`, `mat_texrepeat`, and `headlight_ambient` and `headlight_diffuse`,
    which have the one row 0; see `mjx_arm.varies.EXTRA_FIELDS`. Poses of geoms that vary reach it
    through `geom_xpos` and `geom_xmat`.

    Speed: geoms that are the same in all frames are cast once, when the renderer is made. If the
    camera or the direction of a light varies, or `camera_pose` is given, all geoms are cast in
    every frame.

    The image follows MuJoCo's own renderer. It shows geoms of the groups 0, 1 and 2 with alpha
    above zero, all opaque, in plain colours; planes and boxes may have 2D and cube textures. Light
    is the sum of ambient light, any number of directional lights, and the headlight; pixels that
    hit nothing are black. A shadow removes the diffuse part of its light. Not rendered are sites,
    rangefinder rays, specular light, emission, reflections, the skybox, geoms around the camera,
    and planes from behind. There is no near or far clipping.

    Args:
      scene: an `MjModel`, or an object with one as `mj_model`.
      camera: name of a perspective camera of mode `fixed`, on any body.
      size: height and width of the image, pixels.
      shadows: whether directional lights cast hard shadows, where the model's `castshadow` says so.
      samples: rays through each pixel: 1, 4 or 16. Colours are their mean; the geom id and the
        depth are those of one of them, since a mean would be neither.
      depth: whether to return a second array: z-depth along the optical axis, `[H, W] float32`,
        m, infinite where nothing is hit.
      varies: rows of the model that vary by episode. Fields that do not concern the image are
        ignored.

    Raises:
      ValueError: an argument is invalid, or the model has a geom, tendon, flex, skin, camera or
        light that cannot be rendered. The returned function raises it for poses or `params` of
        wrong names or shapes, and if a camera on a moving body gets no `camera_pose`.
    """
    _validate_size(size)
    if isinstance(samples, bool) or samples not in _SAMPLES:
        raise ValueError(f"samples must be 1, 4 or 16 rays through a pixel, got {samples!r}")
    model = scene if isinstance(scene, mujoco.MjModel) else scene.mj_model
    _validate_varies(model, varies)
    validate_geoms(model, varies)
    spec = make_look_spec(model, camera, varies or {})
    plan = _make_plan(spec, size, shadows, _SAMPLES[samples])
    with jax.ensure_compile_time_eval():
        own = make_look(spec, own_params(model, varies), None)
        background = _cast_background(plan, own) if spec.view_is_constant else None
    render = _packed_and_depth if depth else _packed
    return jax.jit(functools.partial(render, plan, own, background))


def _cast_background(plan: _Plan, own: Look) -> Surface:
    compiled = jax.jit(functools.partial(_background, plan)).lower(own).compile()
    return compiled(own)


@dataclasses.dataclass(frozen=True)
class _Plan:
    """What is known when a renderer is made.

    Attributes:
      spec: camera, lights, model and what varies.
      size: height and width, in rays.
      edge: rays side by side in a pixel.
      still: visible geoms that are the same in all frames.
      still_poses: poses of all geoms, valid for those.
      still_mask: `[ngeom] bool`, which geoms these are.
      moving: the other visible geoms.
      shadows: indices of the lights that cast shadows, in the order of the look.
      still_skins: the textured geoms among the still ones.
      moving_skins: those among the others.
      atlas: the textures, None where no geom has one.
    """

    spec: LookSpec
    size: tuple[int, int]
    edge: int
    still: list[GeomGroup]
    still_poses: GeomPoses
    still_mask: np.ndarray
    moving: list[GeomGroup]
    shadows: tuple[int, ...]
    still_skins: list[Skin]
    moving_skins: list[Skin]
    atlas: Atlas | None


def _make_plan(spec: LookSpec, size: tuple[int, int], shadows: bool, edge: int) -> _Plan:
    model = spec.model
    visible, static = visible_geoms(model, spec.varies), static_geoms(model, spec.varies)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    with jax.ensure_compile_time_eval():
        still_poses = _check_poses(data.geom_xpos, data.geom_xmat, model.ngeom)
    still_skins, moving_skins = (make_skins(model, visible & which) for which in (static, ~static))
    return _Plan(
        spec=spec,
        size=(size[0] * edge, size[1] * edge),
        edge=edge,
        still=geom_groups(model, visible & static),
        still_poses=still_poses,
        still_mask=visible & static,
        moving=geom_groups(model, visible & ~static),
        shadows=tuple(i for i, casts in enumerate(spec.casts_shadow()) if casts and shadows),
        still_skins=still_skins,
        moving_skins=moving_skins,
        atlas=make_atlas(model) if still_skins or moving_skins else None,
    )


def _make_setting(plan: _Plan, look: Look, params: Params) -> Setting:
    height, width = plan.size
    model = plan.spec.model
    view = make_view(look.camera_pos, look.camera_mat, look.camera_fovy, width / height)
    to_lights = [-direction for direction in look.light_dirs]
    lights = [to_light / jnp.sqrt(jnp.sum(to_light**2)) for to_light in to_lights]
    if plan.spec.headlight:
        lights.append(-view.basis[:, 2])
    towards = jnp.stack(lights) if lights else jnp.zeros((0, 3), jnp.float32)
    varies = not plan.spec.view_is_constant
    if varies:
        view, towards = fence((view, towards))
    levels = jnp.round(jnp.clip(look.geom_rgb, 0, 1) * 255).astype(jnp.uint32)
    ids = jnp.arange(model.ngeom, dtype=jnp.uint32)
    return Setting(
        view=view,
        rays=make_rays(view, towards, plan.size),
        lights=towards,
        sizes=fill(model, plan.spec.varies, params, "geom_size"),
        unlit=pack(levels[:, 0], levels[:, 1], levels[:, 2], ids),
        shown=look.geom_shown,
        varies=varies,
    )


def _background(plan: _Plan, look: Look) -> Surface:
    """The geoms that are the same in all frames, with their textures in their own colours."""
    own = own_params(plan.spec.model, plan.spec.varies)
    setting = _make_setting(plan, look, own)
    surface = cast(plan.still, plan.still_poses, setting, empty_surface(setting))
    if not plan.still_skins:
        return surface
    colour = geom_colour(surface)
    colour = _paint(plan, plan.still_skins, colour, setting, plan.still_poses, own)
    channels = (colour.red, colour.green, colour.blue)
    levels = [jnp.round(channel).astype(jnp.uint32) for channel in channels]
    return surface._replace(unlit=pack(levels[0], levels[1], levels[2], colour.geom))


def _depth(surface: Surface) -> tuple[jax.Array, jax.Array]:
    """z-depth `[H, W] float32`, m, 1 where nothing is hit; and whether something is."""
    hit = surface.w > 0
    return 1 / jnp.where(hit, surface.w, jnp.ones_like(surface.w)), hit


def _paint(
    plan: _Plan,
    skins: list[Skin],
    colour: Colour,
    setting: Setting,
    poses: GeomPoses,
    params: Params,
) -> Colour:
    """The colours with the textures of `skins`.

    Their geoms are cast once more, alone: where one is the nearest of all geoms, it is the nearest
    of these. Looking the textures up from the surface of all geoms would cast all of them again,
    since on CPU each array that a kernel leaves behind costs a pass of its own.
    """
    if not skins:
        return colour
    assert plan.atlas is not None
    model, varies = plan.spec.model, plan.spec.varies
    materials = Materials(
        fill(model, varies, params, "mat_texture"), fill(model, varies, params, "mat_texrepeat")
    )
    members = np.zeros(model.ngeom, bool)
    members[[skin.geom for skin in skins]] = True
    nearest = cast(geom_groups(model, members), poses, setting, empty_surface(setting))
    depth, _ = _depth(nearest)
    texels = look_up(nearest.unlit >> 24, depth, setting, poses, skins, plan.atlas, materials)
    return apply_textures(colour, skins, texels)


def _render(
    plan: _Plan,
    own: Look,
    background: Surface | None,
    geom_xpos: ArrayLike,
    geom_xmat: ArrayLike,
    params: Params | None,
    camera_pose: CameraPose | None,
) -> tuple[jax.Array, jax.Array]:
    """Packed pixels, and the z-depth of the nearest surface."""
    spec, params = plan.spec, params or {}
    check_params(spec.model, spec.varies, params)
    _demand_camera_pose(spec, camera_pose)
    poses = _check_poses(geom_xpos, geom_xmat, spec.model.ngeom)
    look = own
    if camera_pose is not None or any(field in spec.varies for field in LOOK_FIELDS):
        look = fence(make_look(spec, params, _check_camera_pose(camera_pose)))
    setting = _make_setting(plan, look, params)
    skins = plan.moving_skins
    if camera_pose is not None or background is None:
        background = cast(plan.still, plan.still_poses, setting, empty_surface(setting))
        skins = plan.still_skins + plan.moving_skins
    surface = cast(plan.moving, poses, setting, background)
    depth, hit = _depth(surface)
    cosines = incidence(surface, depth)
    strength = fill(spec.model, spec.varies, params, "light_shadow")
    for light in plan.shadows:
        dark = covered(plan.moving, poses, setting, depth, light)
        dark = dark | covered(plan.still, plan.still_poses, setting, depth, light)
        number = spec.lights[light]
        if number in spec.varies.get("light_shadow", ()):
            dark = dark & (strength[number] > 0)
        cosines[light] = jnp.where(dark, jnp.zeros_like(depth), cosines[light])
    colour = geom_colour(surface)
    colour = _paint(plan, skins, colour, setting, _all_poses(plan, poses), params)
    packed = shade(colour, cosines, look.light_diffuse, look.ambient)
    return packed, jnp.where(hit, depth, jnp.inf)


def _all_poses(plan: _Plan, poses: GeomPoses) -> GeomPoses:
    still = plan.still_mask[:, None]
    return GeomPoses(
        jnp.where(still, plan.still_poses.xpos, poses.xpos),
        jnp.where(still[..., None], plan.still_poses.xmat, poses.xmat),
    )


def _packed(
    plan: _Plan,
    own: Look,
    background: Surface | None,
    geom_xpos: ArrayLike,
    geom_xmat: ArrayLike,
    params: Params | None = None,
    camera_pose: CameraPose | None = None,
) -> jax.Array:
    packed, _ = _render(plan, own, background, geom_xpos, geom_xmat, params, camera_pose)
    packed = materialize(packed)[0]
    return materialize(average(packed, plan.edge))[0] if plan.edge > 1 else packed


def _packed_and_depth(
    plan: _Plan,
    own: Look,
    background: Surface | None,
    geom_xpos: ArrayLike,
    geom_xmat: ArrayLike,
    params: Params | None = None,
    camera_pose: CameraPose | None = None,
) -> tuple[jax.Array, jax.Array]:
    packed, depth = _render(plan, own, background, geom_xpos, geom_xmat, params, camera_pose)
    packed, depth = materialize(packed, depth)
    if plan.edge > 1:
        middle = slice(plan.edge // 2, None, plan.edge)
        packed, depth = materialize(average(packed, plan.edge), depth[middle, middle])
    return packed, depth


def _check_poses(geom_xpos: ArrayLike, geom_xmat: ArrayLike, ngeom: int) -> GeomPoses:
    xpos, xmat = jnp.asarray(geom_xpos, jnp.float32), jnp.asarray(geom_xmat, jnp.float32)
    if xpos.shape != (ngeom, 3) or xmat.shape not in ((ngeom, 3, 3), (ngeom, 9)):
        raise ValueError(
            f"geom_xpos {list(xpos.shape)} and geom_xmat {list(xmat.shape)} must be [{ngeom}, 3] "
            f"and [{ngeom}, 3, 3], the poses of one frame; use jax.vmap for several"
        )
    return GeomPoses(xpos, xmat.reshape(ngeom, 3, 3))


def _check_camera_pose(camera_pose: CameraPose | None) -> CameraPose | None:
    if camera_pose is None:
        return None
    pos, mat = (jnp.asarray(part, jnp.float32) for part in camera_pose)
    if pos.shape != (3,) or mat.shape not in ((3, 3), (9,)):
        raise ValueError(
            f"camera_pose has the shapes {list(pos.shape)} and {list(mat.shape)}; it must be a "
            "position [3] and axes [3, 3], the pose of one frame; use jax.vmap for several"
        )
    return pos, mat.reshape(3, 3)


def _demand_camera_pose(spec: LookSpec, camera_pose: CameraPose | None) -> None:
    if spec.camera_moves and camera_pose is None:
        raise ValueError(
            f"camera {spec.camera_name!r} is on a moving body: pass its camera_pose, as "
            "mjx_arm.kinematics.make_camera_pose computes it"
        )


def _validate_varies(model: mujoco.MjModel, varies: Varies | None) -> None:
    check_varies(model, varies)
    for field in _CONSTANT_FIELDS:
        if field in (varies or {}):
            raise ValueError(
                f"{field!r} changes the image, but the renderer cannot vary it by episode; "
                f"it varies {', '.join((*_OTHER_FIELDS, *LOOK_FIELDS))}"
            )


def _validate_size(size: object) -> None:
    if (
        not isinstance(size, (tuple, list))
        or len(size) != 2
        or not all(isinstance(length, int | np.integer) and length > 0 for length in size)
    ):
        raise ValueError(f"size={size!r} must be (height, width) in pixels, two positive integers")
