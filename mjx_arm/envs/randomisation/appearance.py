"""What randomisation does to the image: colours, textures, lights, cameras and their sensors."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_arm.envs.randomisation.config import Ranges
from mjx_arm.envs.randomisation.parts import (
    Growth,
    Part,
    between,
    delay_of,
    free_bodies,
    geoms_of,
    is_fixed,
    scaled,
)
from mjx_arm.render.geoms import geom_rgba, texture_of, visible_geoms, why_not_rendered
from mjx_arm.varies import Params, rows

_TWO_PI = float(2 * np.pi)


def appearance_parts(
    mj_model: mujoco.MjModel, ranges: Ranges, cameras: Sequence[str]
) -> list[Part]:
    """The parts that change the image alone.

    Raises:
      ValueError: `ambient_light` varies, and the scene's headlight is not active; or `view_change`
        is too large for the field of view of a camera.
    """
    ids = [int(mj_model.camera(name).id) for name in cameras]
    found = [
        _colours(mj_model, ranges),
        _texture_choice(mj_model, ranges),
        _texture_scale(mj_model, ranges),
        _background(ranges),
        _light_angle(mj_model, ranges),
        _light_strength(mj_model, ranges),
        _ambient(mj_model, ranges),
        _shadows(mj_model, ranges),
        _camera_shift(mj_model, ranges, ids),
        _camera_turn(mj_model, ranges, ids),
        _field_of_view(mj_model, ranges, ids),
        _blur(ranges),
        _gain(ranges),
        _noise(ranges),
        _image_delay(ranges),
    ]
    return [part for part in found if part is not None]


def _colours(model: mujoco.MjModel, ranges: Ranges) -> Part | None:
    visible = np.flatnonzero(visible_geoms(model)).tolist()
    objects = geoms_of(model, free_bodies(model))
    jitter, red = ranges.colour_jitter, ranges.cube_red
    ids = [i for i in visible if jitter > 0 or (red is not None and i in objects)]
    if not ids:
        return None
    own = geom_rgba(model)[ids]
    reddens = np.asarray([i in objects for i in ids])

    def make(uniform: jax.Array, growth: Growth) -> Params:
        uniform = uniform.reshape(-1, 4)
        colour = jnp.asarray(own[:, :3]) + growth * jitter * (2 * uniform[:, :3] - 1)
        if red is not None:
            share = between(uniform[:, 3], *red, own[:, 0], growth)
            colour = colour.at[:, 0].set(jnp.where(reddens, share, colour[:, 0]))
        alpha = jnp.asarray(own[:, 3:])
        return {"geom_rgba": jnp.concatenate([jnp.clip(colour, 0.0, 1.0), alpha], axis=1)}

    return Part({"geom_rgba": tuple(ids)}, 4 * len(ids), make)


def _textured_materials(model: mujoco.MjModel, *, cube: bool | None = None) -> list[int]:
    """Materials of visible textured geoms, of cube or of 2D textures, or of both."""
    materials = set()
    for geom in np.flatnonzero(visible_geoms(model)).tolist():
        texture = texture_of(model, geom)
        if texture >= 0 and cube in (None, _is_cube(model, texture)):
            materials.add(int(model.geom_matid[geom]))
    return sorted(materials)


def _is_cube(model: mujoco.MjModel, texture: int) -> bool:
    return int(model.tex_type[texture]) == int(mujoco.mjtTexture.mjTEXTURE_CUBE)


def _texture_choice(model: mujoco.MjModel, ranges: Ranges) -> Part | None:
    usable = [i for i in range(model.ntex) if not why_not_rendered(model, i)]
    pools = {kind: [i for i in usable if _is_cube(model, i) == kind] for kind in (False, True)}
    own = rows(model, "mat_texture")
    ids = [i for i in _textured_materials(model) if len(pools[_is_cube(model, int(own[i]))]) > 1]
    if ranges.texture_swap == 0 or not ids:
        return None
    choices = [pools[_is_cube(model, int(own[i]))] for i in ids]

    def make(uniform: jax.Array, growth: Growth) -> Params:
        textures = []
        for (swap, which), pool, i in zip(uniform.reshape(-1, 2), choices, ids, strict=True):
            index = jnp.minimum((which * len(pool)).astype(jnp.int32), len(pool) - 1)
            other = jnp.asarray(pool, jnp.float32)[index]
            textures.append(jnp.where(swap < growth * ranges.texture_swap, other, own[i]))
        return {"mat_texture": jnp.stack(textures)}

    return Part({"mat_texture": tuple(ids)}, 2 * len(ids), make)


def _texture_scale(model: mujoco.MjModel, ranges: Ranges) -> Part | None:
    ids = _textured_materials(model, cube=False)
    if is_fixed(ranges.texture_scale, 1.0) or not ids:
        return None
    own = rows(model, "mat_texrepeat")[ids]

    def make(uniform: jax.Array, growth: Growth) -> Params:
        factor = between(uniform, *ranges.texture_scale, 1.0, growth)
        return {"mat_texrepeat": scaled(own, factor[:, None])}

    return Part({"mat_texrepeat": tuple(ids)}, len(ids), make)


def _background(ranges: Ranges) -> Part | None:
    if is_fixed(ranges.background, 0.0):
        return None

    def make(uniform: jax.Array, growth: Growth) -> Params:
        return {"image_background": between(uniform, *ranges.background, 0.0, growth)[None]}

    return Part({"image_background": (0,)}, 3, make)


def _lights(model: mujoco.MjModel) -> list[int]:
    return [int(i) for i in np.flatnonzero(model.light_active)]


def _light_angle(model: mujoco.MjModel, ranges: Ranges) -> Part | None:
    ids = _lights(model)
    if ranges.light_angle == 0 or not ids:
        return None
    own = rows(model, "light_dir")[ids]
    own = own / np.linalg.norm(own, axis=1, keepdims=True)
    # Two directions across each light.
    helper = np.eye(3, dtype=np.float32)[np.argmin(np.abs(own), axis=1)]
    first = np.cross(own, helper)
    first = (first / np.linalg.norm(first, axis=1, keepdims=True)).astype(np.float32)
    second = np.cross(own, first).astype(np.float32)
    most = float(np.deg2rad(ranges.light_angle))

    def make(uniform: jax.Array, growth: Growth) -> Params:
        uniform = uniform.reshape(-1, 2)
        angle, around = growth * most * uniform[:, :1], _TWO_PI * uniform[:, 1:]
        across = jnp.cos(around) * first + jnp.sin(around) * second
        return {"light_dir": jnp.cos(angle) * own + jnp.sin(angle) * across}

    return Part({"light_dir": tuple(ids)}, 2 * len(ids), make)


def _light_strength(model: mujoco.MjModel, ranges: Ranges) -> Part | None:
    ids = _lights(model)
    if is_fixed(ranges.light_strength, 1.0) or not ids:
        return None
    own = rows(model, "light_diffuse")[ids]

    def make(uniform: jax.Array, growth: Growth) -> Params:
        factor = between(uniform, *ranges.light_strength, 1.0, growth)
        return {"light_diffuse": scaled(own, factor[:, None])}

    return Part({"light_diffuse": tuple(ids)}, len(ids), make)


def _ambient(model: mujoco.MjModel, ranges: Ranges) -> Part | None:
    values = ranges.ambient_light
    if values is None:
        return None
    if not model.vis.headlight.active:
        raise ValueError("ambient_light varies, but the scene's headlight is not active")
    own = rows(model, "headlight_ambient")

    def make(uniform: jax.Array, growth: Growth) -> Params:
        level = between(jnp.broadcast_to(uniform, (1, 3)), *values, own, growth)
        return {"headlight_ambient": level}

    return Part({"headlight_ambient": (0,)}, 1, make)


def _shadows(model: mujoco.MjModel, ranges: Ranges) -> Part | None:
    ids = [i for i in _lights(model) if model.light_castshadow[i]]
    if ranges.shadow_share == 1 or not ids:
        return None

    def make(uniform: jax.Array, growth: Growth) -> Params:
        casts = uniform < 1 - growth * (1 - ranges.shadow_share)
        return {"light_shadow": jnp.broadcast_to(casts, (len(ids),)).astype(jnp.float32)}

    return Part({"light_shadow": tuple(ids)}, 1, make)


def _camera_shift(model: mujoco.MjModel, ranges: Ranges, ids: list[int]) -> Part | None:
    if ranges.camera_shift == 0:
        return None
    own = rows(model, "cam_pos")[ids]

    def make(uniform: jax.Array, growth: Growth) -> Params:
        shift = growth * ranges.camera_shift * (2 * uniform.reshape(-1, 3) - 1)
        return {"cam_pos": jnp.asarray(own) + shift}

    return Part({"cam_pos": tuple(ids)}, 3 * len(ids), make)


def _camera_turn(model: mujoco.MjModel, ranges: Ranges, ids: list[int]) -> Part | None:
    if ranges.camera_turn == 0:
        return None
    own = rows(model, "cam_quat")[ids]
    most = float(np.deg2rad(ranges.camera_turn))

    def make(uniform: jax.Array, growth: Growth) -> Params:
        height, around, share = uniform.reshape(-1, 3).T
        height, around = 2 * height - 1, _TWO_PI * around
        flat = jnp.sqrt(jnp.maximum(1 - height * height, 0.0))
        axis = [flat * jnp.cos(around), flat * jnp.sin(around), height]
        half = growth * most * share / 2
        turn = [jnp.cos(half), *(jnp.sin(half) * x for x in axis)]
        return {"cam_quat": jnp.stack(_product(list(own.T), turn), axis=1)}

    return Part({"cam_quat": tuple(ids)}, 3 * len(ids), make)


def _product(p: Sequence[np.ndarray], q: Sequence[jax.Array]) -> list[jax.Array]:
    """The product of quaternions w, x, y, z."""
    return [
        p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3],
        p[0] * q[1] + p[1] * q[0] + p[2] * q[3] - p[3] * q[2],
        p[0] * q[2] - p[1] * q[3] + p[2] * q[0] + p[3] * q[1],
        p[0] * q[3] + p[1] * q[2] - p[2] * q[1] + p[3] * q[0],
    ]


def _field_of_view(model: mujoco.MjModel, ranges: Ranges, ids: list[int]) -> Part | None:
    if ranges.view_change == 0:
        return None
    own = rows(model, "cam_fovy")[ids]
    most = min(own.min(), 180 - own.max())
    if ranges.view_change >= most:
        raise ValueError(
            f"view_change must be below {most:g} degrees, so that the field of view of each camera "
            f"stays between 0 and 180 degrees, got {ranges.view_change:g}"
        )

    def make(uniform: jax.Array, growth: Growth) -> Params:
        return {"cam_fovy": jnp.asarray(own) + growth * ranges.view_change * (2 * uniform - 1)}

    return Part({"cam_fovy": tuple(ids)}, len(ids), make)


def _blur(ranges: Ranges) -> Part | None:
    if is_fixed(ranges.image_blur, 0.0):
        return None

    def make(uniform: jax.Array, growth: Growth) -> Params:
        return {"image_blur": between(uniform, *ranges.image_blur, 0.0, growth)}

    return Part({"image_blur": (0,)}, 1, make)


def _gain(ranges: Ranges) -> Part | None:
    """The exposure, times a factor for each channel."""
    if is_fixed(ranges.exposure, 1.0) and ranges.white_balance == 0:
        return None

    def make(uniform: jax.Array, growth: Growth) -> Params:
        exposure = between(uniform[0], *ranges.exposure, 1.0, growth)
        balance = 1 + growth * ranges.white_balance * (2 * uniform[1:] - 1)
        return {"image_gain": (exposure * balance)[None]}

    return Part({"image_gain": (0,)}, 4, make)


def _noise(ranges: Ranges) -> Part | None:
    if is_fixed(ranges.image_noise, 0.0):
        return None

    def make(uniform: jax.Array, growth: Growth) -> Params:
        deviation = between(uniform[:1], *ranges.image_noise, 0.0, growth)
        return {"image_noise": deviation, "image_seed": uniform[1:]}

    return Part({"image_noise": (0,), "image_seed": (0,)}, 2, make)


def _image_delay(ranges: Ranges) -> Part | None:
    if not ranges.image_delay:
        return None

    def make(uniform: jax.Array, growth: Growth) -> Params:
        return {"image_delay": delay_of(uniform, ranges.image_delay, growth)}

    return Part({"image_delay": (0,)}, 1, make)
