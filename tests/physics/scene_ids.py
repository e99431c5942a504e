"""Where the arm, its gripper and the cube are in the arrays of a scene's model."""

from __future__ import annotations

import dataclasses

import numpy as np

from mjx_arm.envs.arm import resolve_arm
from mjx_arm.envs.tasks.lift import Lift, LiftConfig
from mjx_arm.scene import Scene


@dataclasses.dataclass(frozen=True)
class TaskIds:
    """What `Arm` and `Lift` find in a scene, in one object."""

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
    substeps: int
    mjx_iterations: tuple[int, int]


def resolve_task(scene: Scene) -> TaskIds:
    arm = resolve_arm(scene)
    task = Lift(LiftConfig(), scene, arm)
    return TaskIds(
        arm_qpos=arm.qpos,
        arm_ctrl=arm.ctrl,
        gripper_ctrl=arm.gripper_ctrl,
        finger_qpos=arm.finger_qpos,
        cube_qpos=task.cube_qpos,
        cube_geom=task.cube_geom,
        grasp_site=arm.grasp_site,
        pad_geoms=task.pad_geoms,
        home_qpos=arm.home_qpos,
        home_ctrl=arm.home_ctrl,
        ctrl_range=arm.ctrl_range,
        cube_half_size=task.half_size,
        substeps=scene.substeps,
        mjx_iterations=scene.mjx_iterations,
    )
