"""Scenes: an MJCF file compiled by MuJoCo, and the task's names in it resolved to ids once."""

from __future__ import annotations

import dataclasses
import pathlib

import mujoco
import numpy as np

from mjx_arm.render.geoms import validate_geoms

_PACKAGE = pathlib.Path(__file__).parent
# An installed package carries its scenes; a checkout has them at the top level.
_XML_DIRS = (_PACKAGE / "xml", _PACKAGE.parent / "xml")

NUM_ARM_JOINTS = 6


@dataclasses.dataclass(frozen=True, eq=False)
class Scene:
    """A compiled model of supported primitives; compared and hashed by identity.

    Attributes:
      name: the scene's name or path, as it was asked for.
      mj_model: the plain MuJoCo model. Treat it as read-only.
    """

    name: str
    mj_model: mujoco.MjModel


@dataclasses.dataclass(frozen=True)
class TaskIds:
    """Where the arm, its gripper and the cube are in a scene's arrays.

    Attributes:
      arm_qpos: `[6] int`, addresses of the arm's joints in `qpos`.
      arm_ctrl: `[6] int`, their position servos in `ctrl`, in the same order.
      gripper_ctrl: the gripper's command in `ctrl`.
      finger_qpos: `[2] int`, addresses of the finger slides in `qpos`.
      cube_qpos: address of the cube's free joint in `qpos` (position, then quaternion).
      cube_geom: geom id of the cube.
      grasp_site: site id of the point between the fingers that should meet the cube.
      pad_geoms: `[2, P] int`, geom ids of the spheres on the left and the right finger.
      home_qpos: `[nq] float32`, the keyframe `home`.
      home_ctrl: `[nu] float32`.
      ctrl_range: `[nu, 2] float32`, lower and upper bounds of `ctrl`.
      cube_half_size: half the cube's edge, m.
      cube_rectangle: `[4] float32`, centre x, y and half extents x, y of the cube's places, m.
      substeps: physics substeps in one iteration.
      mjx_iterations: `[2] int`, most iterations of MJX's solver, and of its line search.
    """

    arm_qpos: np.ndarray
    arm_ctrl: np.ndarray
    gripper_ctrl: int
    finger_qpos: np.ndarray
    cube_qpos: int
    cube_geom: int
    grasp_site: int
    pad_geoms: np.ndarray
    home_qpos: np.ndarray
    home_ctrl: np.ndarray
    ctrl_range: np.ndarray
    cube_half_size: float
    cube_rectangle: np.ndarray
    substeps: int
    mjx_iterations: np.ndarray


def available_scenes() -> list[str]:
    """Returns the names of the scenes that come with the package."""
    found = {path.stem for folder in _XML_DIRS for path in folder.glob("*.xml")}
    return sorted(found)


def load_scene(name_or_path: str | pathlib.Path) -> Scene:
    """Compiles a scene that comes with the package, or any MJCF of supported primitives.

    Args:
      name_or_path: a name such as `"arm_cube"`, or the path of an MJCF file.

    Returns:
      The scene.

    Raises:
      ValueError: no such scene or file, MuJoCo cannot compile it, or a geom in it cannot be drawn.
    """
    path = _resolve(str(name_or_path))
    try:
        mj_model = mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        reason = " ".join(str(error).split())
        raise ValueError(f"scene {str(name_or_path)!r} does not compile: {reason}") from error
    validate_geoms(mj_model)
    return Scene(name=str(name_or_path), mj_model=mj_model)


def _resolve(name_or_path: str) -> pathlib.Path:
    for folder in _XML_DIRS:
        if (folder / f"{name_or_path}.xml").is_file():
            return folder / f"{name_or_path}.xml"
    path = pathlib.Path(name_or_path)
    if path.is_file():
        return path
    raise ValueError(
        f"unknown scene {name_or_path!r}: give one of {', '.join(available_scenes())}, "
        "or the path of an MJCF file"
    )


def resolve_task(scene: Scene) -> TaskIds:
    """Finds the arm, gripper and cube of the task in a scene.

    Raises:
      ValueError: a name that the task needs is missing, or is not of the expected kind.
    """
    model = scene.mj_model
    actuators = [model.actuator(i).name for i in range(model.nu)]
    arm = [i for i, name in enumerate(actuators) if name != "gripper"]
    if len(arm) != NUM_ARM_JOINTS or "gripper" not in actuators:
        raise ValueError(
            f"scene {scene.name!r} has the actuators {actuators}; the task needs "
            f"{NUM_ARM_JOINTS} joint servos and one named 'gripper'"
        )
    joints = model.actuator_trnid[arm, 0]
    if (model.actuator_trntype[arm] != mujoco.mjtTrn.mjTRN_JOINT).any() or (
        model.jnt_type[joints] != mujoco.mjtJoint.mjJNT_HINGE
    ).any():
        raise ValueError(f"scene {scene.name!r}: the servos other than 'gripper' must turn hinges")
    home = _id(scene, "key", "home")
    pads = [
        [_id(scene, "geom", f"{side}_pad_{i}") for i in range(_count_pads(model, side))]
        for side in ("left", "right")
    ]
    if not pads[0] or len(pads[0]) != len(pads[1]):
        raise ValueError(
            f"scene {scene.name!r} needs as many geoms 'left_pad_0', ... as 'right_pad_0', ..."
        )
    cube_geom = _id(scene, "geom", "cube")
    fingers = [_id(scene, "joint", f"{side}_finger") for side in ("left", "right")]
    return TaskIds(
        arm_qpos=model.jnt_qposadr[joints],
        arm_ctrl=np.asarray(arm),
        gripper_ctrl=actuators.index("gripper"),
        finger_qpos=model.jnt_qposadr[fingers],
        cube_qpos=int(model.jnt_qposadr[_id(scene, "joint", "cube")]),
        cube_geom=cube_geom,
        grasp_site=_id(scene, "site", "grasp"),
        pad_geoms=np.asarray(pads),
        home_qpos=model.key_qpos[home].astype(np.float32),
        home_ctrl=model.key_ctrl[home].astype(np.float32),
        ctrl_range=model.actuator_ctrlrange.astype(np.float32),
        cube_half_size=float(model.geom_size[cube_geom, 0]),
        cube_rectangle=_numeric(scene, "cube_rectangle", 4),
        substeps=int(_numeric(scene, "substeps", 1)[0]),
        mjx_iterations=_mjx_iterations(scene),
    )


def _count_pads(model: mujoco.MjModel, side: str) -> int:
    names = (model.geom(i).name for i in range(model.ngeom))
    return sum(name.startswith(f"{side}_pad_") for name in names)


def _id(scene: Scene, kind: str, name: str) -> int:
    try:
        return int(getattr(scene.mj_model, kind)(name).id)
    except KeyError:
        what = "keyframe" if kind == "key" else kind
        raise ValueError(f"scene {scene.name!r} has no {what} named {name!r}") from None


def _mjx_iterations(scene: Scene) -> np.ndarray:
    option = scene.mj_model.opt
    if mujoco.mj_name2id(scene.mj_model, mujoco.mjtObj.mjOBJ_NUMERIC, "mjx_iterations") < 0:
        return np.asarray([option.iterations, option.ls_iterations])
    counts = _numeric(scene, "mjx_iterations", 2).astype(int)
    if (counts < 1).any():
        raise ValueError(
            f"scene {scene.name!r}: numeric 'mjx_iterations' must hold two counts from 1"
        )
    return counts


def _numeric(scene: Scene, name: str, size: int) -> np.ndarray:
    data = scene.mj_model.numeric_data
    index = _id(scene, "numeric", name)
    start = scene.mj_model.numeric_adr[index]
    if scene.mj_model.numeric_size[index] != size:
        raise ValueError(f"scene {scene.name!r}: numeric {name!r} must hold {size} numbers")
    return data[start : start + size].astype(np.float32)
