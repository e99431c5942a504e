"""What an image shows besides the poses of the geoms: camera, light and colours."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_arm.render.geoms import geom_rgba

if TYPE_CHECKING:
    from mjx_arm.scene import Scene

# What MuJoCo's renderer falls back to where a model has no light at all.
_AMBIENT_WITHOUT_LIGHTS = 0.3


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Appearance:
    """Camera, light and colours of an image: a pytree, to be randomised and vmapped.

    Attributes:
      camera_pos: `[3] float32`, position of the camera in the world, m.
      camera_mat: `[3, 3] float32`, its axes in columns: x right, y up, looking along -z.
      camera_fovy: `[] float32`, vertical field of view, degrees.
      light_dir: `[3] float32`, where the directional light shines to; any length but zero.
      light_diffuse: `[3] float32`, its red, green and blue.
      ambient: `[3] float32`, red, green and blue of the light that reaches everything.
      geom_rgb: `[ngeom, 3] float32`, colour of every geom, in 0..1.
    """

    camera_pos: jax.Array
    camera_mat: jax.Array
    camera_fovy: jax.Array
    light_dir: jax.Array
    light_diffuse: jax.Array
    ambient: jax.Array
    geom_rgb: jax.Array


def default_appearance(scene: Scene, camera: str = "front") -> Appearance:
    """Reads camera, light and colours from the model of a scene.

    Raises:
      ValueError: the camera is unknown, moves, or is no perspective camera given by its fovy; or
        the model has several lights, or one that moves or is not directional.
    """
    model = scene.mj_model
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_camlight(model, data)
    camera_id = _find_camera(model, camera)
    light = _find_light(model)
    light_dir, diffuse, ambient = np.asarray([0.0, 0.0, -1.0]), np.zeros(3), np.zeros(3)
    if light is not None:
        light_dir = data.light_xdir[light]
        diffuse, ambient = model.light_diffuse[light], model.light_ambient[light]
    headlight = model.vis.headlight
    if headlight.active:
        ambient = ambient + headlight.ambient
    elif light is None:
        ambient = np.full(3, _AMBIENT_WITHOUT_LIGHTS)
    return Appearance(
        camera_pos=_f32(data.cam_xpos[camera_id]),
        camera_mat=_f32(data.cam_xmat[camera_id].reshape(3, 3)),
        camera_fovy=_f32(model.cam_fovy[camera_id]),
        light_dir=_f32(light_dir),
        light_diffuse=_f32(diffuse),
        ambient=_f32(ambient),
        geom_rgb=_f32(geom_rgba(model)[:, :3]),
    )


def headlight_diffuse(mj_model: mujoco.MjModel) -> np.ndarray | None:
    """Colour `[3] float32` of the light along the camera's axis; None where there is none."""
    headlight = mj_model.vis.headlight
    if not headlight.active or not np.any(headlight.diffuse):
        return None
    return np.array(headlight.diffuse, np.float32)


def light_casts_shadow(mj_model: mujoco.MjModel) -> bool:
    """Whether the model has a light, and wants shadows from it."""
    light = _find_light(mj_model)
    return light is not None and bool(mj_model.light_castshadow[light])


def _find_camera(model: mujoco.MjModel, camera: str) -> int:
    names = [model.camera(i).name for i in range(model.ncam)]
    if camera not in names:
        raise ValueError(f"unknown camera {camera!r}: the scene has {names}")
    camera_id = names.index(camera)
    if not _is_fixed(model, model.cam_mode[camera_id], model.cam_bodyid[camera_id]):
        raise ValueError(f"camera {camera!r} moves; supported are cameras fixed to the world")
    perspective = model.cam_projection[camera_id] == mujoco.mjtProjection.mjPROJ_PERSPECTIVE
    if not perspective or np.any(model.cam_sensorsize[camera_id] > 0):
        raise ValueError(
            f"camera {camera!r} is orthographic or has a sensor size; supported are perspective "
            "cameras given by their fovy"
        )
    return camera_id


def _find_light(model: mujoco.MjModel) -> int | None:
    lights = np.flatnonzero(model.light_active)
    if lights.size == 0:
        return None
    names = [model.light(i).name for i in lights]
    if lights.size > 1:
        raise ValueError(f"the scene has the lights {names}; supported is one beside the headlight")
    light = int(lights[0])
    if model.light_type[light] != mujoco.mjtLightType.mjLIGHT_DIRECTIONAL:
        raise ValueError(
            f"light {names[0]!r} is not directional; supported is type='directional' only"
        )
    if not _is_fixed(model, model.light_mode[light], model.light_bodyid[light]):
        raise ValueError(f"light {names[0]!r} moves; supported are lights fixed to the world")
    return light


def _is_fixed(model: mujoco.MjModel, mode: int, body: int) -> bool:
    return mode == mujoco.mjtCamLight.mjCAMLIGHT_FIXED and model.body_weldid[body] == 0


def _f32(array: np.ndarray) -> jax.Array:
    return jnp.asarray(array, jnp.float32)
