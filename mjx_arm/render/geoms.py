"""Which geoms of a MuJoCo model can be drawn, which are visible, and in which colour."""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np

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

_DEFAULT_RGBA = np.asarray([0.5, 0.5, 0.5, 1.0], np.float32)


@dataclasses.dataclass(frozen=True)
class GeomGroup:
    """Geoms of one type, which are cast together.

    Attributes:
      kind: one of the names in `SUPPORTED_TYPES`.
      ids: `[n] int`.
      sizes: `[n, 3] float32`, as `geom_size` of the model, m.
    """

    kind: str
    ids: np.ndarray
    sizes: np.ndarray


def validate_geoms(mj_model: mujoco.MjModel) -> None:
    """Checks that every visible geom of a model can be drawn.

    Raises:
      ValueError: a visible geom is no plane, box, sphere, capsule or cylinder, or wears a
        texture; or there are more than 255 geoms.
    """
    if mj_model.ngeom > MAX_GEOMS:
        raise ValueError(
            f"the model has {mj_model.ngeom} geoms, but a packed image has ids for {MAX_GEOMS}"
        )
    supported = ", ".join(SUPPORTED_TYPES.values())
    for geom in np.flatnonzero(visible_geoms(mj_model)).tolist():
        geom_type = int(mj_model.geom_type[geom])
        if geom_type not in SUPPORTED_TYPES:
            kind = mujoco.mjtGeom(geom_type).name.removeprefix("mjGEOM_").lower()
            raise ValueError(
                f"geom {_label(mj_model, geom)} is of type {kind}, which cannot be drawn; "
                f"supported are {supported}, and geoms of group 3 or higher are not drawn"
            )
        material = mj_model.geom_matid[geom]
        if material >= 0 and np.any(mj_model.mat_texid[material] >= 0):
            raise ValueError(
                f"geom {_label(mj_model, geom)} wears a texture by its material "
                f"{mj_model.material(material).name!r}; supported are plain rgba colours"
            )


def geom_rgba(mj_model: mujoco.MjModel) -> np.ndarray:
    """Colour of every geom as MuJoCo draws it, `[ngeom, 4] float32` in 0..1.

    A geom's own rgba wins over that of its material, unless it is MuJoCo's default grey.
    """
    rgba = np.array(mj_model.geom_rgba, np.float32).reshape(-1, 4)
    material = mj_model.geom_matid
    inherits = (material >= 0) & np.all(rgba == _DEFAULT_RGBA, axis=1)
    rgba[inherits] = mj_model.mat_rgba[material[inherits]]
    return rgba


def visible_geoms(mj_model: mujoco.MjModel) -> np.ndarray:
    """Whether each geom is drawn, `[ngeom] bool`: group 0, 1 or 2, and alpha above zero."""
    return (mj_model.geom_group < VISIBLE_GROUPS) & (geom_rgba(mj_model)[:, 3] > 0)


def static_geoms(mj_model: mujoco.MjModel) -> np.ndarray:
    """Whether each geom is welded to the world, `[ngeom] bool`; mocap bodies are not."""
    return np.asarray(mj_model.body_weldid[mj_model.geom_bodyid] == 0)


def geom_groups(mj_model: mujoco.MjModel, members: np.ndarray) -> list[GeomGroup]:
    """Groups the geoms where `members`, `[ngeom] bool`, is set by type."""
    groups = []
    for geom_type, kind in SUPPORTED_TYPES.items():
        ids = np.flatnonzero(members & (mj_model.geom_type == geom_type))
        if ids.size:
            groups.append(GeomGroup(kind, ids, mj_model.geom_size[ids].astype(np.float32)))
    return groups


def _label(mj_model: mujoco.MjModel, geom: int) -> str:
    name = mj_model.geom(geom).name
    return repr(name) if name else f"with id {geom}"
