"""Which geoms of a MuJoCo model can be rendered, which are visible, and in which colour."""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np

from mjx_arm.varies import Varies

# The packed image has one byte for the geom id, and 255 means that nothing was hit.
MAX_GEOMS = 255

# MuJoCo's default visualisation options show groups 0, 1 and 2.
VISIBLE_GROUPS = 3

SUPPORTED_TYPES = {
    int(mujoco.mjtGeom.mjGEOM_PLANE): "plane",
    int(mujoco.mjtGeom.mjGEOM_BOX): "box",
    int(mujoco.mjtGeom.mjGEOM_SPHERE): "sphere",
    int(mujoco.mjtGeom.mjGEOM_CAPSULE): "capsule",
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): "cylinder",
}

_UNSUPPORTED = {
    "tendon": mujoco.mjtObj.mjOBJ_TENDON,
    "flex": mujoco.mjtObj.mjOBJ_FLEX,
    "skin": mujoco.mjtObj.mjOBJ_SKIN,
}

# Only these have textures that are mapped as MuJoCo maps them.
TEXTURED_KINDS = ("plane", "box")
RGB_ROLE = int(mujoco.mjtTextureRole.mjTEXROLE_RGB)

# MuJoCo takes this colour for "none given".
DEFAULT_RGBA = np.asarray([0.5, 0.5, 0.5, 1.0], np.float32)


@dataclasses.dataclass(frozen=True)
class GeomGroup:
    """Geoms of one type, which are cast together.

    Attributes:
      kind: one of the names in `SUPPORTED_TYPES`.
      ids: `[n] int`.
    """

    kind: str
    ids: np.ndarray


def validate_geoms(mj_model: mujoco.MjModel, varies: Varies | None = None) -> None:
    """Checks that the renderer supports whatever is visible in a model.

    Sites are markers and are never rendered, so they are not checked.

    Args:
      mj_model: the model.
      varies: rows of the model that vary by episode.

    Raises:
      ValueError: a visible geom is no plane, box, sphere, capsule or cylinder, or has a texture
        that cannot be rendered; a spatial tendon, flex or skin is visible; or there are more than
        255 geoms.
    """
    if mj_model.ngeom > MAX_GEOMS:
        raise ValueError(
            f"the model has {mj_model.ngeom} geoms, but a packed image has ids for {MAX_GEOMS}"
        )
    supported = ", ".join(SUPPORTED_TYPES.values())
    for geom in np.flatnonzero(visible_geoms(mj_model, varies)).tolist():
        geom_type = int(mj_model.geom_type[geom])
        if geom_type not in SUPPORTED_TYPES:
            kind = mujoco.mjtGeom(geom_type).name.removeprefix("mjGEOM_").lower()
            raise ValueError(
                f"geom {_label(mj_model, geom)} is of type {kind}, which cannot be rendered; "
                f"supported are {supported}, and geoms of group 3 or higher are not rendered"
            )
        _validate_texture(mj_model, geom)
    _validate_others(mj_model)


def _validate_texture(mj_model: mujoco.MjModel, geom: int) -> None:
    """Rejects a geom whose material has a texture that the renderer cannot show."""
    material = int(mj_model.geom_matid[geom])
    roles = np.flatnonzero(mj_model.mat_texid[material] >= 0) if material >= 0 else np.zeros(0)
    if not roles.size:
        return
    where = (
        f"geom {_label(mj_model, geom)} has a texture by its material "
        f"{mj_model.material(material).name!r}"
    )
    if roles.tolist() != [RGB_ROLE]:
        raise ValueError(f"{where} in another role than 'rgb'; supported are textures of colour")
    if SUPPORTED_TYPES[int(mj_model.geom_type[geom])] not in TEXTURED_KINDS:
        raise ValueError(f"{where}; supported are textures of planes and boxes")
    reason = why_not_rendered(mj_model, texture_of(mj_model, geom))
    if reason:
        raise ValueError(f"{where} that {reason}")


def texture_of(mj_model: mujoco.MjModel, geom: int) -> int:
    """Id of the texture that colours a geom, -1 for none."""
    material = int(mj_model.geom_matid[geom])
    return int(mj_model.mat_texid[material, RGB_ROLE]) if material >= 0 else -1


def why_not_rendered(mj_model: mujoco.MjModel, texture: int) -> str:
    """What keeps a texture from being rendered, such as "is 12 by 7 pixels"; empty for nothing."""
    width, height, channels = (
        int(array[texture])
        for array in (mj_model.tex_width, mj_model.tex_height, mj_model.tex_nchannel)
    )
    if int(mj_model.tex_type[texture]) == int(mujoco.mjtTexture.mjTEXTURE_SKYBOX):
        return "is a skybox"
    if channels not in (3, 4):
        return f"has {channels} channels; it must have 3 or 4"
    cube = int(mj_model.tex_type[texture]) == int(mujoco.mjtTexture.mjTEXTURE_CUBE)
    if width & (width - 1) or (height != width and not (cube and height == 6 * width)):
        return f"is {width} by {height} pixels; its edges must be equal, and a power of two"
    return ""


def _validate_others(mj_model: mujoco.MjModel) -> None:
    """Rejects what MuJoCo shows besides geoms and sites."""
    for kind, number in _UNSUPPORTED.items():
        alpha = getattr(mj_model, f"{kind}_rgba").reshape(-1, 4)[:, 3]
        visible = (getattr(mj_model, f"{kind}_group") < VISIBLE_GROUPS) & (alpha > 0)
        if kind == "tendon":
            # A fixed tendon is a sum of joints and has no shape.
            visible &= mj_model.wrap_type[mj_model.tendon_adr] != mujoco.mjtWrap.mjWRAP_JOINT
        for i in np.flatnonzero(visible).tolist():
            raise ValueError(
                f"{kind} {_label(mj_model, i, number)} is visible but cannot be rendered; "
                "supported are geoms only, and groups of 3 or higher are not rendered"
            )


def geom_rgba(mj_model: mujoco.MjModel) -> np.ndarray:
    """Colour of every geom as MuJoCo renders it, `[ngeom, 4] float32` in 0..1.

    A geom's own rgba wins over that of its material, unless it is MuJoCo's default grey.
    """
    rgba = np.array(mj_model.geom_rgba, np.float32).reshape(-1, 4)
    material = mj_model.geom_matid
    inherits = (material >= 0) & np.all(rgba == DEFAULT_RGBA, axis=1)
    rgba[inherits] = mj_model.mat_rgba[material[inherits]]
    return rgba


def visible_geoms(mj_model: mujoco.MjModel, varies: Varies | None = None) -> np.ndarray:
    """Whether each geom is rendered, `[ngeom] bool`: group 0, 1 or 2, and alpha above zero.

    Where the colour varies by episode, alpha may be above zero in some episodes, and counts so.
    """
    opaque = geom_rgba(mj_model)[:, 3] > 0
    opaque[list((varies or {}).get("geom_rgba", ()))] = True
    return (mj_model.geom_group < VISIBLE_GROUPS) & opaque


def static_geoms(mj_model: mujoco.MjModel, varies: Varies | None = None) -> np.ndarray:
    """Whether each geom is the same in all frames, `[ngeom] bool`.

    These are the geoms that are welded to the world, unless their pose, size, colour or texture
    varies by episode. Geoms of mocap bodies are not static.
    """
    static = np.asarray(mj_model.body_weldid[mj_model.geom_bodyid] == 0)
    static &= ~varying_bodies(mj_model, varies)[mj_model.geom_bodyid]
    for field in ("geom_pos", "geom_quat", "geom_size", "geom_rgba"):
        static[list((varies or {}).get(field, ()))] = False
    for field in ("mat_texture", "mat_texrepeat"):
        static[np.isin(mj_model.geom_matid, (varies or {}).get(field, ()))] = False
    return static


def varying_bodies(mj_model: mujoco.MjModel, varies: Varies | None) -> np.ndarray:
    """Whether `varies` moves each body or one of its ancestors in its parent, `[nbody] bool`."""
    varying = np.zeros(mj_model.nbody, bool)
    for field in ("body_pos", "body_quat"):
        varying[list((varies or {}).get(field, ()))] = True
    # The world's own pose is never read.
    varying[0] = False
    for body in range(1, mj_model.nbody):
        varying[body] |= varying[mj_model.body_parentid[body]]
    return varying


def geom_groups(mj_model: mujoco.MjModel, members: np.ndarray) -> list[GeomGroup]:
    """Groups the geoms where `members`, `[ngeom] bool`, is set by type."""
    groups = []
    for geom_type, kind in SUPPORTED_TYPES.items():
        ids = np.flatnonzero(members & (mj_model.geom_type == geom_type))
        if ids.size:
            groups.append(GeomGroup(kind, ids))
    return groups


def _label(
    mj_model: mujoco.MjModel, number: int, kind: mujoco.mjtObj = mujoco.mjtObj.mjOBJ_GEOM
) -> str:
    name = mujoco.mj_id2name(mj_model, kind, number)
    return repr(name) if name else f"with id {number}"
