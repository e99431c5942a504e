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
import functools
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
        another, the largest first. Each face begins at a multiple of its largest size, so that the
        low bits of a place are the column, and the next ones the row.
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
    """Collects the textures of a model; those that cannot be rendered are left out.

    The rows of a texture that is left out have no meaning.
    """
    pieces: list[np.ndarray] = []
    start, stride, levels = (np.zeros(mj_model.ntex, np.int32) for _ in range(3))
    size = 0
    for texture in range(mj_model.ntex):
        if why_not_rendered(mj_model, texture):
            continue
        whole = int(mj_model.tex_width[texture]) ** 2
        # 4/3 of the largest size, and what is left until the next multiple of it.
        faces = [_padded(_pyramid(face), 2 * whole) for face in _images(mj_model, texture)]
        gap = -size % whole
        start[texture] = size + gap
        stride[texture] = 2 * whole if len(faces) > 1 else 0
        levels[texture] = int(mj_model.tex_width[texture]).bit_length() - 1
        pieces += [np.zeros(gap, np.uint32), *faces]
        size += gap + sum(len(face) for face in faces)
    return Atlas(
        texels=np.concatenate(pieces) if pieces else np.zeros(1, np.uint32),
        start=start,
        stride=stride,
        levels=levels,
        cube=np.asarray(mj_model.tex_type) == _CUBE,
    )


def _padded(texels: np.ndarray, size: int) -> np.ndarray:
    return np.concatenate([texels, np.zeros(size - len(texels), np.uint32)])


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


class Materials(NamedTuple):
    """The textures of the materials in an episode.

    Attributes:
      texture: `[nmat] float32`, the id of each material's texture.
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


class Texels(NamedTuple):
    """What each pixel found, each `[H, W]`.

    Attributes:
      corners: four packed texels: upper left, upper right, lower left and lower right.
      x: share of the way from the left to the right ones, 0..1.
      y: share of the way from the upper to the lower ones.
    """

    corners: tuple[jax.Array, ...]
    x: jax.Array
    y: jax.Array


def look_up(
    geom: jax.Array,
    depth: jax.Array,
    setting: Setting,
    poses: GeomPoses,
    skins: list[Skin],
    atlas: Atlas,
    materials: Materials,
) -> Texels:
    """Looks the textures up at every pixel.

    Args:
      geom: `[H, W] uint32`, id of the nearest textured geom.
      depth: `[H, W] float32`, its z-depth, m.
      setting: camera and sizes.
      poses: of all geoms.
      skins: the textured geoms, at least one.
      atlas: the textures.
      materials: which texture each material has, and how often it repeats.

    Returns:
      The texels of each pixel; without meaning where `geom` is none of `skins`.
    """
    chosen: _Lookup | None = None
    for skin in skins:
        found = _look(skin, depth, setting, poses, atlas, materials)
        here = geom == jnp.uint32(skin.geom)
        chosen = found if chosen is None else _where(here, found, chosen)
    assert chosen is not None
    return _sample(chosen, depth, setting, atlas)


def apply_textures(colour: Colour, skins: list[Skin], texels: Texels) -> Colour:
    """Multiplies the colours of textured geoms by their textures."""
    textured = functools.reduce(
        jnp.logical_or, (colour.geom == jnp.uint32(skin.geom) for skin in skins)
    )
    red, green, blue = (
        jnp.where(textured, own * texel * np.float32(1 / 255), own)
        for own, texel in zip((colour.red, colour.green, colour.blue), _mix(texels), strict=True)
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
    materials: Materials,
) -> _Lookup:
    """Where each pixel would look if it showed this geom."""
    xpos, xmat = poses.xpos[skin.geom], poses.xmat[skin.geom]
    origin = matvec(xmat.T, setting.view.origin - xpos)
    forms = matmul(xmat.T, setting.view.basis)
    size = jnp.asarray(setting.sizes[skin.geom], jnp.float32)
    # An infinite plane has the size 0, and repeats its texture by metres.
    inverse = 1 / jnp.where(size > 0, size, jnp.ones_like(size))
    repeat = jnp.asarray(materials.repeat[skin.material], jnp.float32) / 2
    repeat = repeat / inverse[:2] if skin.uniform else repeat
    begin = jnp.where(size[:2] > 0, repeat, -0.5)
    # As floats, because a fence has no effect on integers; they are exact up to 16 million texels.
    number = jnp.asarray(materials.texture[skin.material]).astype(jnp.int32)
    tables = [
        jnp.asarray(table, jnp.float32)[number]
        for table in (atlas.start, atlas.levels, atlas.stride)
    ]
    origin, forms, inverse, repeat, begin, tables, density = fence(
        (origin, forms, inverse, repeat, begin, tables, jnp.mean(inverse))
    )
    start, levels, stride = (value.astype(jnp.int32) for value in tables)
    rays = [affine(form, setting.rays.u, setting.rays.v) for form in forms]
    point = [o + depth * ray for o, ray in zip(origin, rays, strict=True)]
    unit = [x * k for x, k in zip(point, inverse, strict=True)]
    normal = _normal_of_box(unit, forms) if skin.box else (forms[2, 0], forms[2, 1], forms[2, 2])
    if skin.cube:
        mean = jnp.ones_like(density) if skin.uniform else density
        s, t, density, face = _on_cube(point if skin.uniform else unit, mean, skin.uniform)
        start = start + stride * face
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
    direction: list[jax.Array], density: jax.Array, metric: bool
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Coordinates s and t, density and face 0 to 5 (+x, -x, +y, -y, +z, -z), each `[H, W]`.

    Table 8.19 of OpenGL 4.6.

    Args:
      direction: from the geom's centre, three times `[H, W]`, in half lengths or in metres.
      density: units of it in a metre, 1/m.
      metric: whether it is in metres.
    """
    x, y, z = direction
    along_z = jnp.abs(z) >= greater(jnp.abs(x), jnp.abs(y))
    along_x = ~along_z & (jnp.abs(x) >= jnp.abs(y))
    major = jnp.where(along_z, z, jnp.where(along_x, x, y))
    back = major < 0
    right = jnp.where(along_x, jnp.where(back, z, -z), jnp.where(along_z & back, -x, x))
    down = jnp.where(along_x | along_z, -y, jnp.where(back, -z, z))
    # In half lengths it is 1 on the surface.
    half = 0.5 / greater(jnp.abs(major), jnp.full_like(major, _TINY)) if metric else 0.5
    axis = jnp.where(along_z, 4, jnp.where(along_x, 0, 2))
    face = axis + back.astype(jnp.int32)
    return right * half + 0.5, down * half + 0.5, half * density, face


def _sample(look: _Lookup, depth: jax.Array, setting: Setting, atlas: Atlas) -> Texels:
    """Looks up the four texels around the place that each pixel sees."""
    level = jnp.clip(look.levels + _step_level(look, depth, setting), 0, look.levels)
    left = look.levels - level
    # The sizes before this one have 4^n + 4^(n-1) + ... texels; (4^k - 1) / 3 is every second bit.
    bits = [0x55555555 & ((4 << (2 * x)) - 1) for x in (look.levels, left)]
    before = bits[0] - bits[1]
    mask = (1 << left) - 1
    edge = (1 << left).astype(jnp.float32)
    x, y = look.s * edge - 0.5, look.t * edge - 0.5
    x0, y0 = jnp.floor(x), jnp.floor(y)
    column, row = (_wrap(z.astype(jnp.int32), mask, look.clamped) for z in (x0, y0))
    place = look.start + before + (row << left) + column
    # Before the first texel there is none to mix with, where the texture does not repeat.
    x, y = (
        jnp.where(look.clamped & (low < 0), jnp.zeros_like(low), full - low)
        for low, full in ((x0, x), (y0, y))
    )
    return _read(place, left, look.clamped, x, y, atlas)


class _Word(NamedTuple):
    """Layout of the uint32 by which a pixel's place in the atlas goes from one kernel to the next.

    Attributes:
      place: bits of the index of the upper left texel.
      share: bits of each of the two shares.
    """

    place: int
    share: int


def _word_of(atlas: Atlas) -> _Word:
    # No place has all bits set, so no word is the value that `materialize` takes for impossible.
    place = len(atlas.texels).bit_length()
    # Four bits are log2 of the edge, one says whether the texture repeats.
    return _Word(place, min(8, (32 - 5 - place) // 2))


def _read(
    place: jax.Array,
    left: jax.Array,
    clamped: jax.Array,
    x: jax.Array,
    y: jax.Array,
    atlas: Atlas,
) -> Texels:
    """Reads the texels at a place, right of it, below it, and right below it.

    A kernel with lookups in memory is not vectorised, so it has nothing else to do. The one before
    it leaves a single word for each pixel.
    """
    bits = _word_of(atlas)
    steps = 1 << bits.share
    shares = [lesser(jnp.floor(z * steps), jnp.full_like(z, steps - 1)) for z in (x, y)]
    fields = [(place, 0), (left, bits.place), (clamped, bits.place + 4)]
    fields += [(z, bits.place + 5 + i * bits.share) for i, z in enumerate(shares)]
    word = jnp.zeros(place.shape, jnp.uint32)
    for value, shift in fields:
        word = word | (value.astype(jnp.uint32) << shift)
    (word,) = materialize(word)

    def field(shift: int, size: int) -> jax.Array:
        return ((word >> shift) & ((1 << size) - 1)).astype(jnp.int32)

    place, left = field(0, bits.place), field(bits.place, 4)
    clamped = field(bits.place + 4, 1) > 0
    mask = (1 << left) - 1
    column, row = place & mask, (place >> left) & mask
    right, below = (_wrap(z + 1, mask, clamped) - z for z in (column, row))
    texels = jnp.asarray(atlas.texels)
    places = [place, place + right, place + (below << left), place + (below << left) + right]
    corners = materialize(*(texels.at[i].get(mode="promise_in_bounds") for i in places))
    x, y = (
        (field(bits.place + 5 + i * bits.share, bits.share).astype(jnp.float32) + 0.5) / steps
        for i in (0, 1)
    )
    return Texels(corners, x, y)


def _step_level(look: _Lookup, depth: jax.Array, setting: Setting) -> jax.Array:
    """log2 of how far the texture moves from a pixel to the next, in its edges, `[H, W] int32`.

    The larger one of the ways to the right and upwards, as in OpenGL 4.6, equation 8.9, rounded.
    The point of a plane with normal n that the ray d meets at depth z moves by
    `z (r - d (r n) / (d n))` when the ray moves by r.
    """
    rays, (height, width) = setting.rays, depth.shape
    facing = look.normal[0] * rays.u + (look.normal[1] * rays.v + look.normal[2])
    right2, up2, _ = jnp.sum(setting.view.basis**2, axis=0)
    # Times (d n)², so that there is no division.
    across2, along2 = (
        ray2 * facing * (facing - 2 * place * normal) + rays.norm2 * normal * normal
        for ray2, place, normal in (
            (right2, rays.u, look.normal[0]),
            (up2, rays.v, look.normal[1]),
        )
    )
    ways = greater(across2 * (2 / width) ** 2, along2 * (2 / height) ** 2)
    # Floats as whole numbers are their log2 in steps of 2^-23, within 0.09.
    top, bottom = (
        jax.lax.bitcast_convert_type(x, jnp.int32)
        for x in (2 * ways * (depth * look.density) ** 2, facing * facing + _TINY**2)
    )
    return (top - bottom) >> 24


def _wrap(place: jax.Array, mask: jax.Array, clamped: jax.Array) -> jax.Array:
    held = lesser(greater(place, jnp.zeros_like(place)), mask)
    return jnp.where(clamped, held, place & mask)


def _mix(texels: Texels) -> list[jax.Array]:
    """Bilinear interpolation: red, green and blue, each `[H, W] float32` in 0..255."""
    channels = []
    for shift in (0, 8, 16):
        a, b, c, d = (((texel >> shift) & 255).astype(jnp.float32) for texel in texels.corners)
        upper, lower = a + texels.x * (b - a), c + texels.x * (d - c)
        channels.append(upper + texels.y * (lower - upper))
    return channels
