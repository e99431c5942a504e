"""Any arm of position servos with a gripper: its joints, its limits and its table of actions."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_arm.scene import Scene

_GRIPPER = "gripper"
_FINGERS = ("left_finger", "right_finger")
_SITE = "grasp"
_HOME = "home"

_JOINT = int(mujoco.mjtTrn.mjTRN_JOINT)
_TENDON = int(mujoco.mjtTrn.mjTRN_TENDON)
_HINGE = int(mujoco.mjtJoint.mjJNT_HINGE)
_SLIDE = int(mujoco.mjtJoint.mjJNT_SLIDE)
# A servo follows its command at once, or by a filter; integrators and muscles make it another kind.
_FOLLOWING = (
    int(mujoco.mjtDyn.mjDYN_NONE),
    int(mujoco.mjtDyn.mjDYN_FILTER),
    int(mujoco.mjtDyn.mjDYN_FILTEREXACT),
)


@dataclasses.dataclass(frozen=True)
class Arm:
    """Where an arm of n joints and its gripper are in a model's arrays.

    Attributes:
      qpos: `[n] int`, addresses of the arm's joints in `qpos`.
      ctrl: `[n] int`, their position servos in `ctrl`, in the same order.
      slides: `[n] bool`, which of the joints are slides (m); the others are hinges (rad).
      gripper_ctrl: the gripper's command in `ctrl`; its upper end is open, its lower end shut.
      finger_qpos: `[2] int`, addresses of the finger joints in `qpos`.
      grasp_site: site id of the point between the fingers.
      home_qpos: `[nq] float32`, the keyframe `home`.
      home_ctrl: `[nu] float32`.
      ctrl_range: `[nu, 2] float32`, lower and upper bounds of `ctrl`.
    """

    qpos: np.ndarray
    ctrl: np.ndarray
    slides: np.ndarray
    gripper_ctrl: int
    finger_qpos: np.ndarray
    grasp_site: int
    home_qpos: np.ndarray
    home_ctrl: np.ndarray
    ctrl_range: np.ndarray

    @property
    def num_joints(self) -> int:
        """Number of joints n, without the fingers."""
        return len(self.qpos)

    @property
    def num_actions(self) -> int:
        """Number of actions, 2 n + 2."""
        return 2 * self.num_joints + 2

    @property
    def open_action(self) -> int:
        """The action that opens the gripper."""
        return 2 * self.num_joints

    @property
    def close_action(self) -> int:
        """The action that closes the gripper."""
        return 2 * self.num_joints + 1

    def commanded(self, qpos: jax.Array, ctrl: jax.Array) -> jax.Array:
        """`qpos [nq] float32` with the arm's joints where their commands would have them."""
        # A select of gathered commands: XLA on CPU runs a scatter as a loop.
        source = np.zeros(qpos.shape, int)
        source[self.qpos] = self.ctrl
        mask = np.zeros(qpos.shape, bool)
        mask[self.qpos] = True
        return jnp.where(mask, ctrl[source], qpos)


def resolve_arm(scene: Scene) -> Arm:
    """Finds the arm in a scene: every actuator but `gripper` is a servo of one of its joints.

    The scene needs an actuator `gripper`, joints `left_finger` and `right_finger`, a site `grasp`
    and a keyframe `home`.

    Raises:
      ValueError: a name is missing; an actuator is not a position servo of a hinge or slide with
        limits; or the keyframe is outside of the limits.
    """
    model = scene.mj_model
    names = [model.actuator(i).name for i in range(model.nu)]
    servos = [i for i, name in enumerate(names) if name != _GRIPPER]
    if _GRIPPER not in names or not servos:
        raise ValueError(
            f"scene {scene.name!r} has the actuators {names}; an arm needs at least one servo of "
            f"a joint, and one actuator named {_GRIPPER!r}"
        )
    for servo in range(model.nu):
        _check_servo(scene, servo)
    joints = model.actuator_trnid[servos, 0]
    _check_joints(scene, servos, joints)
    gripper = names.index(_GRIPPER)
    if model.actuator_trntype[gripper] not in (_JOINT, _TENDON):
        raise ValueError(
            f"scene {scene.name!r}: the actuator {_GRIPPER!r} must move a joint or a tendon"
        )
    fingers = [scene.find("joint", name) for name in _FINGERS]
    _check_kinds(scene, fingers)
    home = scene.find("key", _HOME)
    arm = Arm(
        qpos=model.jnt_qposadr[joints],
        ctrl=np.asarray(servos),
        slides=model.jnt_type[joints] == _SLIDE,
        gripper_ctrl=gripper,
        finger_qpos=model.jnt_qposadr[fingers],
        grasp_site=scene.find("site", _SITE),
        home_qpos=model.key_qpos[home].astype(np.float32),
        home_ctrl=model.key_ctrl[home].astype(np.float32),
        ctrl_range=np.stack([_range(scene, servo) for servo in range(model.nu)]),
    )
    _check_home(scene, arm)
    return arm


def _label(scene: Scene, servo: int) -> str:
    name = scene.mj_model.actuator(servo).name
    return f"scene {scene.name!r}: actuator {name!r}" if name else f"actuator {servo}"


def _check_servo(scene: Scene, servo: int) -> None:
    model = scene.mj_model
    gain, bias = model.actuator_gainprm[servo], model.actuator_biasprm[servo]
    affine = model.actuator_biastype[servo] == mujoco.mjtBias.mjBIAS_AFFINE
    fixed = model.actuator_gaintype[servo] == mujoco.mjtGain.mjGAIN_FIXED
    follows = model.actuator_dyntype[servo] in _FOLLOWING
    # The force kp (ctrl - qpos) - kv qvel, without a constant.
    linear = gain[0] > 0 and bias[0] == 0 and bias[1] == -gain[0]
    if not (affine and fixed and follows and linear):
        raise ValueError(
            f"{_label(scene, servo)} is not a position servo: define it by <position kp=... />"
        )
    if model.actuator_gear[servo, 0] != 1.0 or model.actuator_gear[servo, 1:].any():
        raise ValueError(
            f"{_label(scene, servo)} has the gear {model.actuator_gear[servo].tolist()}; "
            "supported is a gear of 1"
        )


def _check_joints(scene: Scene, servos: list[int], joints: np.ndarray) -> None:
    model = scene.mj_model
    for servo in servos:
        if model.actuator_trntype[servo] != _JOINT:
            raise ValueError(f"{_label(scene, servo)} must move a joint, a hinge or a slide")
    _check_kinds(scene, joints.tolist())
    if len(set(joints.tolist())) != len(joints):
        raise ValueError(f"scene {scene.name!r} has several servos for one joint of the arm")


def _check_kinds(scene: Scene, joints: list[int]) -> None:
    for joint in joints:
        if scene.mj_model.jnt_type[joint] not in (_HINGE, _SLIDE):
            name = scene.mj_model.joint(joint).name
            raise ValueError(f"scene {scene.name!r}: joint {name!r} must be a hinge or a slide")


def _range(scene: Scene, servo: int) -> np.ndarray:
    model = scene.mj_model
    bounds = model.actuator_ctrlrange[servo]
    if not model.actuator_ctrllimited[servo] or not bounds[0] < bounds[1]:
        raise ValueError(
            f"{_label(scene, servo)} has no range of commands: give it ctrlrange or inheritrange"
        )
    joint = model.actuator_trnid[servo, 0]
    if model.actuator_trntype[servo] == _JOINT and model.jnt_limited[joint]:
        # A command beyond the joint's own range would be one for a pose that it cannot take.
        low, high = model.jnt_range[joint]
        bounds = np.clip(bounds, low, high)
    return bounds.astype(np.float32)


def _check_home(scene: Scene, arm: Arm) -> None:
    low, high = arm.ctrl_range.T
    outside = np.flatnonzero((arm.home_ctrl < low) | (arm.home_ctrl > high))
    if outside.size:
        raise ValueError(
            f"{_label(scene, int(outside[0]))}: the keyframe {_HOME!r} commands "
            f"{arm.home_ctrl[outside[0]]}, outside of its range"
        )
    differs = np.abs(arm.home_qpos[arm.qpos] - arm.home_ctrl[arm.ctrl]) > 1e-4
    if differs.any():
        servo = int(arm.ctrl[np.flatnonzero(differs)[0]])
        raise ValueError(
            f"{_label(scene, servo)}: the keyframe {_HOME!r} must have the joint where its "
            "command puts it"
        )


def apply_action(
    arm: Arm, ctrl: jax.Array, action: jax.Array, degrees: float, millimetres: float
) -> jax.Array:
    """Moves the target of one servo.

    Actions `2 j` and `2 j + 1` move joint `j` by minus and plus one step; the last two open and
    close the gripper by its whole travel (James & Johns 2016, section 3.2).

    Args:
      arm: the arm.
      ctrl: `[nu] float32`, rad and m.
      action: `[] int32`, 0 to 2 n + 1.
      degrees: step of a hinge.
      millimetres: step of a slide.

    Returns:
      `[nu] float32`, clipped to the servos' ranges.
    """
    low, high = arm.ctrl_range.T
    table = np.zeros((arm.num_actions, len(ctrl)), np.float32)
    for joint, index in enumerate(arm.ctrl):
        step = millimetres / 1000.0 if arm.slides[joint] else np.deg2rad(degrees)
        table[2 * joint, index] = -step
        table[2 * joint + 1, index] = step
    moved = ctrl + jnp.asarray(table)[action]
    gripper = jnp.where(
        action == arm.open_action,
        high[arm.gripper_ctrl],
        jnp.where(action == arm.close_action, low[arm.gripper_ctrl], ctrl[arm.gripper_ctrl]),
    )
    return jnp.clip(moved.at[arm.gripper_ctrl].set(gripper), low, high)


def arm_features(arm: Arm, qpos: jax.Array, ctrl: jax.Array, grasp_pos: jax.Array) -> jax.Array:
    """State features of an arm, `[n + 5] float32`.

    The joints (rad and m), the mean finger opening and the gripper's command (m), and the grasp
    site's position (m).
    """
    opening = jnp.mean(qpos[arm.finger_qpos], keepdims=True)
    command = ctrl[arm.gripper_ctrl][None]
    return jnp.concatenate([qpos[arm.qpos], opening, command, grasp_pos])


def arm_feature_scales(arm: Arm) -> tuple[float, ...]:
    """Factors that bring `arm_features` to a size of about 1."""
    joints = [10.0 if slide else 1.0 for slide in arm.slides]
    return (*joints, 20.0, 20.0, 5.0, 5.0, 5.0)
