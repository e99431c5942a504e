"""Scenes to render, and MuJoCo's own answers to what a camera sees of them."""

from __future__ import annotations

import pathlib

import mujoco
import numpy as np

from mjx_arm.render.geoms import geom_rgba
from mjx_arm.scene import Scene

ARM_XML = pathlib.Path(__file__).parents[2] / "xml" / "arm_cube.xml"

SHOWN_GROUPS = np.asarray([1, 1, 1, 0, 0, 0], np.uint8)
_RAY_RANGE = 1e10

_SHAPES = ("box", "sphere", "capsule", "cylinder")


def scene_of(xml: str) -> Scene:
    return Scene(name="test", mj_model=mujoco.MjModel.from_xml_string(xml), xml=xml)


def random_primitives(seed: int, count: int = 8, lights: str = "") -> Scene:
    """Free bodies of all round and flat shapes over a floor, before a wall of finite size."""
    rng = np.random.default_rng(seed)
    bodies = []
    for i in range(count):
        size = " ".join(f"{x:.4f}" for x in rng.uniform(0.03, 0.12, 3))
        colour = " ".join(f"{x:.3f}" for x in rng.uniform(0.1, 0.9, 3))
        bodies.append(
            f'<body name="b{i}"><freejoint/><geom type="{_SHAPES[i % 4]}" size="{size}" '
            f'rgba="{colour} 1" mass="1"/></body>'
        )
    return scene_of(f"""
<mujoco>
  <visual>
    <headlight ambient="0.2 0.25 0.3" diffuse="0.2 0.15 0.1" specular="0 0 0"/>
    <map znear="0.005" zfar="20"/>
    <quality numslices="64" numstacks="32" shadowsize="2048"/>
  </visual>
  <statistic center="0 0 0.4" extent="1"/>
  <asset><material name="matte" rgba="0.3 0.5 0.7 1" specular="0"/></asset>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <light type="directional" pos="-1 -1 2.5" dir="0.5 0.3 -1" diffuse="0.5 0.55 0.4"
           specular="0 0 0"/>
    {lights}
    <camera name="front" pos="1.3 -0.9 1.1" xyaxes="0.57 0.82 0 -0.45 0.31 0.84" fovy="50"/>
    <geom name="floor" type="plane" size="0 0 1" rgba="0.4 0.4 0.35 1"/>
    <geom name="wall" type="plane" size="0.4 0.7 1" pos="-0.7 0.3 0.4" euler="0 80 0"
          material="matte"/>
    <geom name="step" type="box" size="0.2 0.3 0.02" pos="0 0 0.02" material="matte"/>
    <geom name="pole" type="cylinder" size="0.02 0.3" pos="-0.3 -0.3 0.3" material="matte"/>
    <geom name="hidden" type="box" size="0.5 0.5 0.5" group="3"/>
    <geom name="clear" type="box" size="0.4 0.4 0.4" rgba="1 1 1 0"/>
    {"".join(bodies)}
  </worldbody>
</mujoco>""")


def random_qpos(model: mujoco.MjModel, count: int, seed: int) -> np.ndarray:
    """Joint positions `[count, nq]`: joints within their range, free bodies above the floor."""
    rng = np.random.default_rng(seed)
    qpos = np.tile(model.key_qpos[0] if model.nkey else model.qpos0, (count, 1))
    for joint in range(model.njnt):
        start = model.jnt_qposadr[joint]
        if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE:
            low, high = ([0.26, -0.15, 0.04], [0.46, 0.15, 0.25])
            if model.nkey == 0:
                low, high = ([-0.5, -0.5, 0.15], [0.5, 0.5, 0.8])
            qpos[:, start : start + 3] = rng.uniform(low, high, (count, 3))
            qpos[:, start + 3 : start + 7] = _unit(rng.normal(size=(count, 4)))
        elif model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE:
            qpos[:, start] = rng.uniform(*model.jnt_range[joint], count)
        else:
            qpos[:, start] += rng.uniform(-0.35, 0.35, count)
    return qpos


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def at(model: mujoco.MjModel, qpos: np.ndarray | None = None) -> mujoco.MjData:
    data = mujoco.MjData(model)
    if qpos is not None:
        data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    return data


def geom_poses(model: mujoco.MjModel, qposes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Poses of all geoms, `[N, ngeom, 3]` and `[N, ngeom, 3, 3]` float32."""
    states = [at(model, qpos) for qpos in qposes]
    xpos = np.stack([data.geom_xpos for data in states]).astype(np.float32)
    xmat = np.stack([data.geom_xmat for data in states]).astype(np.float32)
    return xpos, xmat.reshape(*xpos.shape[:2], 3, 3)


def pixel_rays(mat: np.ndarray, fovy: float, size: tuple[int, int]) -> np.ndarray:
    """Directions `[H, W, 3]` through the pixel centres, one unit long along the optical axis."""
    height, width = size
    half = np.tan(np.deg2rad(fovy) / 2)
    x = ((np.arange(width) + 0.5) / width * 2 - 1) * half * width / height
    y = (1 - (np.arange(height) + 0.5) / height * 2) * half
    x, y = np.meshgrid(x, y)
    return np.stack([x, y, -np.ones_like(x)], axis=-1) @ np.reshape(mat, (3, 3)).T


def cast_rays(
    model: mujoco.MjModel, data: mujoco.MjData, pos: np.ndarray, directions: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Geom ids, -1 for none; distances in lengths of `directions`; normals; by `mj_multiRay`."""
    shape = directions.shape[:-1]
    length = np.linalg.norm(directions, axis=-1)
    unit = np.ascontiguousarray((directions / length[..., None]).reshape(-1))
    count = length.size
    geom, distance, normal = np.full(count, -1, np.int32), np.zeros(count), np.zeros(3 * count)
    mujoco.mj_multiRay(
        model, data, pos, unit, SHOWN_GROUPS, 1, -1, geom, distance, normal, count, _RAY_RANGE
    )
    distance = np.where(geom < 0, np.inf, distance).reshape(shape)
    return geom.reshape(shape), distance / length, normal.reshape(*shape, 3)


def cast_camera(
    model: mujoco.MjModel, data: mujoco.MjData, camera: str, size: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Geom ids and z-depths `[H, W]` and normals `[H, W, 3]` that a camera of the model sees."""
    number = model.camera(camera).id
    directions = pixel_rays(data.cam_xmat[number], model.cam_fovy[number], size)
    return cast_rays(model, data, data.cam_xpos[number], directions)


def shaded(
    model: mujoco.MjModel, data: mujoco.MjData, camera: str, geom: np.ndarray, normal: np.ndarray
) -> np.ndarray:
    """Colours `[H, W, 3]` in 0..255 of what `cast_camera` found, without shadows."""
    headlight = model.vis.headlight
    axis = data.cam_xmat[model.camera(camera).id].reshape(3, 3)[:, 2]
    light = headlight.ambient + np.maximum(normal @ axis, 0)[..., None] * headlight.diffuse
    for i in np.flatnonzero(model.light_active):
        cosine = np.maximum(normal @ -data.light_xdir[i], 0)[..., None]
        light = light + model.light_ambient[i] + cosine * model.light_diffuse[i]
    colour = np.where(geom[..., None] >= 0, geom_rgba(model)[geom, :3], 0)
    return 255 * np.minimum(colour * light, 1)


def wrist_scene() -> Scene:
    """The arm, with a camera `wrist` on its gripper."""
    spec = mujoco.MjSpec.from_file(str(ARM_XML))
    spec.body("gripper").add_camera(
        name="wrist", pos=[0.03, 0.01, 0.06], quat=[0.55, 0.38, -0.47, -0.58], fovy=70
    )
    return Scene(name="wrist", mj_model=spec.compile(), xml=spec.to_xml())
