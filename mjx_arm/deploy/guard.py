"""What an arm may do: the ranges of its joints, and the box that its gripper stays in."""

from __future__ import annotations

import dataclasses
import functools

import mujoco
import numpy as np

from mjx_arm.deploy.robot import RobotError
from mjx_arm.envs.arm import Arm
from mjx_arm.scene import Scene

# How far a measured angle may be outside of the range of its joint, degrees.
_TOLERANCE = 3.0
# The default box: distance to its sides from the grasp site at home, heights of its ends, m.
_AROUND, _LOWEST, _HIGHEST = 0.5, 0.005, 0.7


@dataclasses.dataclass(frozen=True, eq=False)
class Guard:
    """Checks the joints of an arm, and rejects steps that would lead it out of bounds.

    Attributes:
      limits: `[n, 2] float64`, lower and upper bounds of the joints, degrees.
      box: `[2, 3] float64`, lower and upper corner of where the grasp site may be, m.
      scene: whose kinematics say where the grasp site is.
      arm: the arm in it.
    """

    limits: np.ndarray
    box: np.ndarray
    scene: Scene
    arm: Arm

    def __post_init__(self) -> None:
        """Raises ValueError for a box without a volume, or an arm with slides."""
        if self.arm.slides.any():
            raise ValueError(
                f"scene {self.scene.name!r} has an arm with slides; a robot moves hinges by degrees"
            )
        if self.box.shape != (2, 3) or not (self.box[0] < self.box[1]).all():
            raise ValueError(
                "the workspace must be x y z of its lower corner, then of its upper corner, m, "
                f"got {self.box.ravel().tolist()}"
            )

    def check(self, angles: object) -> np.ndarray:
        """Returns the measured angles, degrees, if they are valid.

        Raises:
          RobotError: they are not an array `[n]`, or one is not finite, or is more than 3 degrees
            outside of its range.
        """
        count = len(self.limits)
        if not isinstance(angles, np.ndarray) or angles.shape != (count,):
            shape = list(getattr(angles, "shape", ()))
            raise RobotError(f"the robot must report {count} joint angles, got the shape {shape}")
        for joint, angle in enumerate(angles.tolist()):
            low, high = self.limits[joint]
            if not low - _TOLERANCE <= angle <= high + _TOLERANCE:
                raise RobotError(
                    f"joint {joint} reports {angle:.1f} degrees; its range is from {low:.1f} to "
                    f"{high:.1f}"
                )
        return angles

    def rejects(self, angles: np.ndarray, joint: int, degrees: float) -> str | None:
        """Why a step is rejected, as a sentence; None if it is allowed.

        Steps that lead back from beyond a bound are allowed.

        Args:
          angles: `[n] float64`, degrees, as measured.
          joint: 0 to n - 1.
          degrees: of the step.
        """
        after = angles.copy()
        after[joint] += degrees
        low, high = self.limits[joint]
        if (after[joint] > high and degrees > 0) or (after[joint] < low and degrees < 0):
            return f"joint {joint} would leave its range"
        beyond = self._beyond(after)
        if beyond > 0 and beyond > self._beyond(angles):
            return "the gripper would leave the workspace"
        return None

    def gripper(self, angles: np.ndarray) -> np.ndarray:
        """Where the grasp site is at joint angles `[n]`, degrees: `[3] float64`, m."""
        data = self._data
        data.qpos[self.arm.qpos] = np.deg2rad(angles)
        mujoco.mj_kinematics(self.scene.mj_model, data)
        return data.site_xpos[self.arm.grasp_site].copy()

    @functools.cached_property
    def _data(self) -> mujoco.MjData:
        data = mujoco.MjData(self.scene.mj_model)
        data.qpos[:] = self.arm.home_qpos
        return data

    def _beyond(self, angles: np.ndarray) -> float:
        """How far the grasp site is out of the box, m."""
        at = self.gripper(angles)
        return float(np.linalg.norm(np.maximum(np.maximum(self.box[0] - at, at - self.box[1]), 0)))


def make_guard(scene: Scene, arm: Arm, workspace: tuple[float, ...] | None = None) -> Guard:
    """The guard of an arm: the ranges of its servos, and a box.

    Args:
      scene: the scene.
      arm: the arm in it.
      workspace: x, y, z of the lower corner of the box, then of the upper one, m. By default half a
        metre around the grasp site at home, from 5 mm to 70 cm above the ground.

    Raises:
      ValueError: the arm has slides, or `workspace` is not six numbers of a box with a volume.
    """
    limits = np.rad2deg(arm.ctrl_range[arm.ctrl].astype(np.float64))
    if workspace is not None:
        box = np.asarray(workspace, np.float64)
        return Guard(limits, box.reshape(2, 3) if box.size == 6 else box, scene, arm)
    data = mujoco.MjData(scene.mj_model)
    data.qpos[:] = arm.home_qpos
    mujoco.mj_kinematics(scene.mj_model, data)
    x, y, _ = data.site_xpos[arm.grasp_site]
    low, high = (x - _AROUND, y - _AROUND, _LOWEST), (x + _AROUND, y + _AROUND, _HIGHEST)
    return Guard(limits, np.asarray([low, high]), scene, arm)
