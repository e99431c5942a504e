"""Textures of planes and boxes, mapped as MuJoCo's OpenGL renderer maps them.

A 2D texture covers each face of a box, and the whole of a finite plane, `texrepeat` times along
both axes; with `texuniform` it is repeated as often again as the geom's half length has metres. On
an infinite plane it repeats every `2 / texrepeat` metres. A cube texture is looked up in the
direction from the geom's centre, in half lengths or, with `texuniform`, in metres, on the face of
the largest component. `tests/render/test_texture.py` compares each case with MuJoCo 3.17.

Each texture is kept at all sizes down to one pixel. At every pixel of the image the size is taken
whose texels are nearest to the pixel's footprint, and four texels are interpolated. OpenGL
interpolates between two such sizes as well.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_arm.render.algebra import fence, greater, lesser, matmul, matvec
from mjx_arm.render.colour import Colour
from mjx_arm.render.geoms import texture_of, why_not_rendered
from mjx_arm.render.materialize import materialize
from mjx_arm.render.rays import affine
from mjx_arm.render.surface import GeomPoses, Setting

_CUBE = int(mujoco.mjtTexture.mjTEXTURE_CUBE)
_SRGB = int(mujoco.mjtColorSpace.mjCOLORSPACE_SRGB)
# Keeps a reciprocal finite where a ray grazes a face.
_TINY = 1e-6


@dataclasses.dataclass(frozen=True)
class Atlas:
    """All textures of a model at all sizes, in one array.

    Attributes:
      texels: `[n] uint32`, red, green and blue in the low three bytes. A texture's sizes follow one
        another, the largest first.
      start: `[ntex] int32`, where the first face of a texture begins.
      stride: `[ntex] int32`, from one face of a cube to the next; 0 where all are the same.
      levels: `[ntex] int32`, log2 of the edge.
      cube: `[ntex] bool`, cube textures; the others are 2D.
    """

    texels: np.ndarray
    start: np.ndarray
    stride: np.ndarray
    levels: np.ndarray
    cube: np.ndarray


def make_atlas(mj_model: mujoco.MjModel) -> Atlas:
    """Collects the textures of a model; those that cannot be rendered are left out."""
    pieces: list[np.ndarray] = []
    start, stride, levels = (np.zeros(mj_model.ntex, np.int32) for _ in range(3))
    size = 0
    for texture in range(mj_model.ntex):
        if why_not_rendered(mj_model, texture):
            continue
        faces = [_pyramid(face) for face in _images(mj_model, texture)]
        start[texture] = size
        stride[texture] = len(faces[0]) if len(faces) > 1 else 0
        levels[texture] = int(mj_model.tex_width[texture]).bit_length() - 1
        pieces += faces
        size += sum(len(face) for face in faces)
    return Atlas(
        texels=np.concatenate(pieces) if pieces else np.zeros(1, np.uint32),
        start=start,
        stride=stride,
        levels=levels,
        cube=np.asarray(mj_model.tex_type) == _CUBE,
    )


def mean_colour(mj_model: mujoco.MjModel, texture: int) -> np.ndarray:
    """The mean of a texture's pixels, `[3] float64` in 0..1."""
    return np.mean(_images(mj_model, texture), axis=(0, 1, 2)) / 255


def _images(mj_model: mujoco.MjModel, texture: int) -> list[np.ndarray]:
    """The image of a 2D texture, or of a cube's faces where they differ: `[W, W, 3]` in 0..255."""
    width, height, channels = (
        int(array[texture])
        for array in (mj_model.tex_width, mj_model.tex_height, mj_model.tex_nchannel)
    )
    begin = int(mj_model.tex_adr[texture])
    data = np.asarray(mj_model.tex_data[begin : begin + width * height * channels])
    image = data.reshape(height, width, channels)[..., :3].astype(np.float64)
    if int(mj_model.tex_colorspace[texture]) == _SRGB:
        # IEC 61966-2-1: OpenGL computes with linear light.
        share = image / 255
        low, high = share / 12.92, ((share + 0.055) / 1.055) ** 2.4
        image = 255 * np.where(share <= 0.04045, low, high)
    return np.split(image, height // width)


def _pyramid(image: np.ndarray) -> np.ndarray:
    """Packed texels of `[W, W, 3]` at W, W / 2, ..., 1 pixels, `[n] uint32`."""
    levels = []
    while True:
        levels.append(np.round(image).astype(np.uint32).reshape(-1, 3))
        if len(image) == 1:
            break
        half = len(image) // 2
        image = image.reshape(half, 2, half, 2, 3).mean(axis=(1, 3))
    texels = np.concatenate(levels)
    return texels[:, 0] | (texels[:, 1] << 8) | (texels[:, 2] << 16)


@dataclasses.dataclass(frozen=True)
class Skin:
    """How one geom is textured.

    Attributes:
      geom: its id.
      material: id of its material.
      box: whether it is a box; the others are planes.
      cube: whether its texture is a cube; it stays one where textures vary.
      uniform: whether the texture repeats by metres instead of by half lengths.
    """

    geom: int
    material: int
    box: bool
    cube: bool
    uniform: bool


def make_skins(mj_model: mujoco.MjModel, members: np.ndarray) -> list[Skin]:
    """The textured geoms where `members`, `[ngeom] bool`, is set."""
    return [
        Skin(
            geom,
            int(mj_model.geom_matid[geom]),
            int(mj_model.geom_type[geom]) == int(mujoco.mjtGeom.mjGEOM_BOX),
            int(mj_model.tex_type[texture_of(mj_model, geom)]) == _CUBE,
            bool(mj_model.mat_texuniform[mj_model.geom_matid[geom]]),
        )
        for geom in np.flatnonzero(members).tolist()
        if texture_of(mj_model, geom) >= 0
    ]


class Papers(NamedTuple):
    """What the materials have by episode.

    Attributes:
      texture: `[nmat] float32`, ids of their textures.
      repeat: `[nmat, 2] float32`, as `mat_texrepeat` of the model.
    """

    texture: jax.Array | np.ndarray
    repeat: jax.Array | np.ndarray


class _Lookup(NamedTuple):
    """Where each pixel looks, each `[H, W]`.

    Attributes:
      s: first coordinate, 0..1 from the left to the right edge of the texture.
      t: second coordinate, 0..1 from the top to the bottom edge.
      density: textures side by side on a metre of the surface, 1/m.
      normal: form of the ray's component along the normal of the face: its three coefficients.
      start: where the face's texels begin.
      levels: log2 of the texture's edge.
      clamped: whether the texture ends at its edges instead of repeating.
    """

    s: jax.Array
    t: jax.Array
    density: jax.Array
    normal: tuple[jax.Array, jax.Array, jax.Array]
    start: jax.Array
    levels: jax.Array
    clamped: jax.Array


def apply_textures(
    colour: Colour,
    depth: jax.Array,
    setting: Setting,
    poses: GeomPoses,
    skins: list[Skin],
    atlas: Atlas,
    papers: Papers,
) -> Colour:
    """Multiplies the colours of textured geoms by their textures.

    Args:
      colour: of the nearest surface.
      depth: `[H, W] float32`, its z-depth, m.
      setting: camera and sizes.
      poses: of all geoms.
      skins: the textured geoms, at least one.
      atlas: the textures.
      papers: which texture each material has, and how often it repeats.
    """
    textured = jnp.zeros(depth.shape, bool)
    chosen: _Lookup | None = None
    for skin in skins:
        found = _look(skin, depth, setting, poses, atlas, papers)
        here = colour.geom == jnp.uint32(skin.geom)
        textured = textured | here
        chosen = found if chosen is None else _where(here, found, chosen)
    assert chosen is not None
    texels = _sample(chosen, depth, setting, atlas)
    red, green, blue = (
        jnp.where(textured, own * texel * np.float32(1 / 255), own)
        for own, texel in zip((colour.red, colour.green, colour.blue), texels, strict=True)
    )
    return Colour(red, green, blue, colour.geom)


def _where(condition: jax.Array, one: _Lookup, other: _Lookup) -> _Lookup:
    chosen: _Lookup = jax.tree.map(lambda a, b: jnp.where(condition, a, b), one, other)
    return chosen


def _look(
    skin: Skin,
    depth: jax.Array,
    setting: Setting,
    poses: GeomPoses,
    atlas: Atlas,
    papers: Papers,
) -> _Lookup:
    """Where each pixel would look if it showed this geom."""
    xpos, xmat = poses.xpos[skin.geom], poses.xmat[skin.geom]
    origin = matvec(xmat.T, setting.view.origin - xpos)
    forms = matmul(xmat.T, setting.view.basis)
    size = jnp.asarray(setting.sizes[skin.geom], jnp.float32)
    # An infinite plane has the size 0, and repeats its texture by metres.
    inverse = 1 / jnp.where(size > 0, size, jnp.ones_like(size))
    repeat = jnp.asarray(papers.repeat[skin.material], jnp.float32) / 2
    repeat = repeat / inverse[:2] if skin.uniform else repeat
    begin = jnp.where(size[:2] > 0, repeat, -0.5)
    origin, forms, inverse, repeat, begin = fence((origin, forms, inverse, repeat, begin))
    rays = [affine(form, setting.rays.u, setting.rays.v) for form in forms]
    point = [o + depth * ray for o, ray in zip(origin, rays, strict=True)]
    unit = [x * k for x, k in zip(point, inverse, strict=True)]
    number = jnp.asarray(papers.texture[skin.material]).astype(jnp.int32)
    start, levels = jnp.asarray(atlas.start)[number], jnp.asarray(atlas.levels)[number]
    normal = _normal_of_box(unit, forms) if skin.box else (forms[2, 0], forms[2, 1], forms[2, 2])
    if skin.cube:
        s, t, density, face = _on_cube(*((point, 1.0) if skin.uniform else (unit, inverse)))
        start = start + jnp.asarray(atlas.stride)[number] * face
    else:
        place = _on_box(unit, inverse) if skin.box else (unit[0], unit[1], inverse[0], inverse[1])
        s, t = begin[0] + repeat[0] * place[0], begin[1] - repeat[1] * place[1]
        density = greater(repeat[0] * place[2], repeat[1] * place[3])
    parts = _Lookup(s, t, density, normal, start, levels, jnp.asarray(skin.cube))
    whole: _Lookup = jax.tree.map(lambda x: jnp.broadcast_to(x, depth.shape), parts)
    return whole


def _face_of_box(unit: list[jax.Array]) -> tuple[jax.Array, jax.Array]:
    """Whether the face at each pixel is across y, and across z; otherwise it is across x."""
    reach = [jnp.abs(x) for x in unit]
    across_z = reach[2] > greater(reach[0], reach[1])
    return ~across_z & (reach[1] > reach[0]), across_z


def _normal_of_box(
    unit: list[jax.Array], forms: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The form of the axis that the face at each pixel is across."""
    across_y, across_z = _face_of_box(unit)
    x, y, z = (
        jnp.where(across_z, forms[2, i], jnp.where(across_y, forms[1, i], forms[0, i]))
        for i in range(3)
    )
    return x, y, z


def _on_box(
    unit: list[jax.Array], inverse: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Coordinates along the face in half lengths, and one over these half lengths, 1/m.

    They are y and z on a face across x, x and z on one across y, and x and y on one across z.
    """
    across_y, across_z = _face_of_box(unit)
    across_x = ~across_y & ~across_z
    return (
        jnp.where(across_x, unit[1], unit[0]),
        jnp.where(across_z, unit[1], unit[2]),
        jnp.where(across_x, inverse[1], inverse[0]),
        jnp.where(across_z, inverse[1], inverse[2]),
    )


def _on_cube(
    direction: list[jax.Array], scale: jax.Array | float
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Coordinates s and t, density and face 0 to 5 (+x, -x, +y, -y, +z, -z), each `[H, W]`.

    Table 8.19 of OpenGL 4.6. `scale` has the units of `direction` in a metre, `[3]` or one number.
    """
    x, y, z = direction
    along_z = jnp.abs(z) >= greater(jnp.abs(x), jnp.abs(y))
    along_x = ~along_z & (jnp.abs(x) >= jnp.abs(y))
    major = jnp.where(along_z, z, jnp.where(along_x, x, y))
    back = major < 0
    right = jnp.where(along_x, jnp.where(back, z, -z), jnp.where(along_z & back, -x, x))
    down = jnp.where(along_x | along_z, -y, jnp.where(back, -z, z))
    half = 0.5 / greater(jnp.abs(major), jnp.full_like(major, _TINY))
    axis = jnp.where(along_z, 4, jnp.where(along_x, 0, 2))
    face = axis + back.astype(jnp.int32)
    return right * half + 0.5, down * half + 0.5, half * jnp.mean(scale), face


def _sample(
    look: _Lookup, depth: jax.Array, setting: Setting, atlas: Atlas
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Red, green and blue of the textures, each `[H, W] float32` in 0..255."""
    step2 = _footprint2(look, depth, setting)
    # The exponent of a float is the whole part of its log2: half of that of 2 x² is the nearest to
    # log2(x).
    bits = jax.lax.bitcast_convert_type(2 * step2, jnp.int32)
    level = jnp.clip(look.levels + (((bits >> 23) - 127) >> 1), 0, look.levels)
    left = look.levels - level
    # The sizes before this one have 4^n + 4^(n-1) + ... texels.
    before = ((4 << (2 * look.levels)) - (4 << (2 * left))) // 3
    start, mask = look.start + before, (1 << left) - 1
    edge = (1 << left).astype(jnp.float32)
    x, y = look.s * edge - 0.5, look.t * edge - 0.5
    x0, y0 = jnp.floor(x), jnp.floor(y)
    columns = [_wrap(x0.astype(jnp.int32) + i, mask, look.clamped) for i in (0, 1)]
    rows = [_wrap(y0.astype(jnp.int32) + i, mask, look.clamped) << left for i in (0, 1)]
    places = [(start + row + column).astype(jnp.uint32) for row in rows for column in columns]
    # A kernel with lookups in memory is not vectorised: it must not have the other arithmetic of
    # the image in it, before or after, which would take ten times as long.
    *places, x, y = materialize(*places, x - x0, y - y0)
    texels = jnp.asarray(atlas.texels)
    corners = materialize(*(texels.at[i].get(mode="promise_in_bounds") for i in places))
    return _mix(list(corners), x, y)


def _footprint2(look: _Lookup, depth: jax.Array, setting: Setting) -> jax.Array:
    """Square of how far the texture moves from a pixel to the next, in its edges, `[H, W]`.

    The larger one of the ways to the right and upwards, as in OpenGL 4.6, equation 8.9. The point
    of a plane with normal n that the ray d meets at depth z moves by `z (r - d (r n) / (d n))`
    when the ray moves by r.
    """
    rays, (height, width) = setting.rays, depth.shape
    facing = look.normal[0] * rays.u + (look.normal[1] * rays.v + look.normal[2])
    inverse = 1 / jnp.where(jnp.abs(facing) < _TINY, _TINY, facing)
    right2, up2, _ = jnp.sum(setting.view.basis**2, axis=0)
    right, up = look.normal[0] * inverse, look.normal[1] * inverse
    across2 = right2 * (1 - 2 * rays.u * right) + rays.norm2 * right * right
    along2 = up2 * (1 - 2 * rays.v * up) + rays.norm2 * up * up
    ways = greater(across2 * (2 / width) ** 2, along2 * (2 / height) ** 2)
    return ways * (depth * look.density) ** 2


def _wrap(place: jax.Array, mask: jax.Array, clamped: jax.Array) -> jax.Array:
    held = lesser(greater(place, jnp.zeros_like(place)), mask)
    return jnp.where(clamped, held, place & mask)


def _mix(
    corners: list[jax.Array], x: jax.Array, y: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Bilinear interpolation of four packed texels: upper left, upper right, lower left, ..."""
    channels = []
    for shift in (0, 8, 16):
        a, b, c, d = (((texel >> shift) & 255).astype(jnp.float32) for texel in corners)
        upper, lower = a + x * (b - a), c + x * (d - c)
        channels.append(upper + y * (lower - upper))
    return channels[0], channels[1], channels[2]
