"""Camera, lights and colours of a frame: from the model, or from what varies by episode."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.typing import ArrayLike

from mjx_arm.kinematics import find_camera, make_camera_pose
from mjx_arm.render.algebra import matvec
from mjx_arm.render.geoms import DEFAULT_RGBA, geom_rgba, varying_bodies
from mjx_arm.varies import Params, Varies, fill, replace_rows, rows

CameraPose: TypeAlias = tuple[ArrayLike, ArrayLike]
"""Position `[3]`, m, and axes `[3, 3]` in columns: x right, y up, looking along -z."""

# The ambient light of MuJoCo's renderer where a model has no light at all.
_AMBIENT_WITHOUT_LIGHTS = 0.3

LOOK_FIELDS = (
    "geom_rgba",
    "light_dir",
    "light_diffuse",
    "light_ambient",
    "headlight_ambient",
    "headlight_diffuse",
    "cam_pos",
    "cam_quat",
    "cam_fovy",
    "body_pos",
    "body_quat",
)


class Look(NamedTuple):
    """What an image shows besides the poses of the geoms.

    Attributes:
      camera_pos: `[3] float32`, position of the camera in the world, m.
      camera_mat: `[3, 3] float32`, its axes in columns: x right, y up, looking along -z.
      camera_fovy: `[] float32`, vertical field of view, degrees.
      light_dirs: per directional light `[3] float32`, where it shines to; any length but zero.
      light_diffuse: per light `[3] float32`, red, green and blue; that of the headlight comes last.
      ambient: `[3] float32`, red, green and blue of the light that reaches everything.
      geom_rgb: `[ngeom, 3] float32`, colour of every geom, in 0..1.
      geom_shown: `[ngeom] bool`, whether alpha is above zero; None where no colour varies.
    """

    camera_pos: jax.Array
    camera_mat: jax.Array
    camera_fovy: jax.Array
    light_dirs: tuple[jax.Array, ...]
    light_diffuse: tuple[jax.Array, ...]
    ambient: jax.Array
    geom_rgb: jax.Array
    geom_shown: jax.Array | None


@dataclasses.dataclass(frozen=True, eq=False)
class LookSpec:
    """Which camera and lights of a model an image is made with.

    Attributes:
      model: the model.
      camera: id of the camera.
      lights: ids of the directional lights that are switched on.
      headlight: whether the light along the camera's axis has a diffuse part.
      varies: rows of the model that vary by episode.
    """

    model: mujoco.MjModel
    camera: int
    lights: tuple[int, ...]
    headlight: bool
    varies: Varies

    @property
    def camera_name(self) -> str:
        """Name of the camera."""
        return self.model.camera(self.camera).name

    @property
    def camera_moves(self) -> bool:
        """Whether the camera is on a body that moves in the world."""
        return bool(self.model.body_weldid[self.model.cam_bodyid[self.camera]] != 0)

    @property
    def camera_pose_varies(self) -> bool:
        """Whether `params` move a camera that is welded to the world."""
        body = self.model.cam_bodyid[self.camera]
        own = any(self._varies(field, self.camera) for field in ("cam_pos", "cam_quat"))
        return own or bool(varying_bodies(self.model, self.varies)[body])

    @property
    def view_is_constant(self) -> bool:
        """Whether camera and directions of lights are the same in all frames."""
        camera = self.camera_moves or self.camera_pose_varies
        fovy = self._varies("cam_fovy", self.camera)
        return not (camera or fovy or any(self._varies("light_dir", i) for i in self.lights))

    def casts_shadow(self) -> tuple[bool, ...]:
        """Whether each directional light casts shadows."""
        return tuple(bool(self.model.light_castshadow[light]) for light in self.lights)

    def _varies(self, field: str, row: int) -> bool:
        return row in self.varies.get(field, ())


def make_look_spec(model: mujoco.MjModel, camera: str, varies: Varies) -> LookSpec:
    """Resolves the camera and the lights of a model.

    Raises:
      ValueError: the camera is unknown, not fixed to a body, or no perspective camera given by its
        fovy; a light moves, or is not directional; or the headlight varies but is not active.
    """
    camera_id = find_camera(model, camera)
    perspective = model.cam_projection[camera_id] == mujoco.mjtProjection.mjPROJ_PERSPECTIVE
    if not perspective or np.any(model.cam_sensorsize[camera_id] > 0):
        raise ValueError(
            f"camera {camera!r} is orthographic or has a sensor size; supported are perspective "
            "cameras given by their fovy"
        )
    headlight = model.vis.headlight
    for field in ("headlight_ambient", "headlight_diffuse"):
        if varies.get(field) and not headlight.active:
            raise ValueError(f"{field!r} varies, but the model's headlight is not active")
    diffuse = bool(varies.get("headlight_diffuse")) or bool(np.any(headlight.diffuse))
    lights = tuple(np.flatnonzero(model.light_active).tolist())
    for light in lights:
        _check_light(model, light, varies)
    return LookSpec(model, camera_id, lights, bool(headlight.active) and diffuse, varies)


def _check_light(model: mujoco.MjModel, light: int, varies: Varies) -> None:
    name = repr(model.light(light).name) if model.light(light).name else f"with id {light}"
    if model.light_type[light] != mujoco.mjtLightType.mjLIGHT_DIRECTIONAL:
        raise ValueError(f"light {name} is not directional; supported is type='directional' only")
    body = model.light_bodyid[light]
    fixed = model.light_mode[light] == mujoco.mjtCamLight.mjCAMLIGHT_FIXED
    if not fixed or model.body_weldid[body] != 0 or varying_bodies(model, varies)[body]:
        raise ValueError(f"light {name} moves; supported are lights fixed to the world")


def make_look(spec: LookSpec, params: Params, camera_pose: CameraPose | None) -> Look:
    """Returns the look of a frame, constant where nothing of it varies.

    Args:
      spec: camera and lights.
      params: what varies.
      camera_pose: pose of the camera. None means the model's pose, at `qpos0` if it moves.
    """
    model, varies = spec.model, spec.varies
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_camlight(model, data)

    def field(name: str) -> jax.Array | np.ndarray:
        return fill(model, varies, params, name)

    if camera_pose is not None:
        pos, mat = camera_pose
    elif spec.camera_pose_varies:
        # No joint is between the camera and the world.
        place = make_camera_pose(model, spec.camera_name, varies)
        pos, mat = place(jnp.zeros(model.nq, jnp.float32), params)
    else:
        pos, mat = data.cam_xpos[spec.camera], data.cam_xmat[spec.camera]
    if varies.get("light_dir"):
        directions = field("light_dir")
        axes = data.xmat[model.light_bodyid].reshape(-1, 3, 3).astype(np.float32)
        dirs = [matvec(jnp.asarray(axes[i]), jnp.asarray(directions[i])) for i in spec.lights]
    else:
        dirs = [_f32(data.light_xdir[i]) for i in spec.lights]
    diffuse = [_f32(field("light_diffuse")[i]) for i in spec.lights]
    if spec.headlight:
        diffuse.append(_f32(field("headlight_diffuse")[0]))
    geom_rgb, geom_shown = _colours(spec, params)
    return Look(
        camera_pos=_f32(pos),
        camera_mat=_f32(mat).reshape(3, 3),
        camera_fovy=_f32(field("cam_fovy")[spec.camera]),
        light_dirs=tuple(dirs),
        light_diffuse=tuple(diffuse),
        ambient=_ambient(spec, params),
        geom_rgb=geom_rgb,
        geom_shown=geom_shown,
    )


def _ambient(spec: LookSpec, params: Params) -> jax.Array:
    model, varies = spec.model, spec.varies
    ambient = fill(model, varies, params, "light_ambient")
    terms = [ambient[light] for light in spec.lights]
    if model.vis.headlight.active:
        terms.append(fill(model, varies, params, "headlight_ambient")[0])
    elif not terms:
        terms.append(np.full(3, _AMBIENT_WITHOUT_LIGHTS, np.float32))
    total = terms[0]
    for term in terms[1:]:
        total = total + term
    return _f32(total)


def _colours(spec: LookSpec, params: Params) -> tuple[jax.Array, jax.Array | None]:
    """Colours `[ngeom, 3]`, and whether alpha is above zero, `[ngeom]`, or None."""
    model = spec.model
    own = geom_rgba(model)
    ids = tuple(spec.varies.get("geom_rgba", ()))
    if not ids:
        return _f32(own[:, :3]), None
    values = jnp.asarray(params["geom_rgba"], jnp.float32)
    # MuJoCo takes this very grey for "no colour given".
    material = model.geom_matid[list(ids)]
    inherits = jnp.all(values == DEFAULT_RGBA, axis=1) & (material >= 0)
    if np.any(material >= 0):
        inherited = jnp.asarray(rows(model, "mat_rgba")[material])
        values = jnp.where(inherits[:, None], inherited, values)
    rgba = replace_rows(own, ids, values)
    return rgba[:, :3], rgba[:, 3] > 0


def _f32(array: ArrayLike) -> jax.Array:
    return jnp.asarray(array, jnp.float32)
