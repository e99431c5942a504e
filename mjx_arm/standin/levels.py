"""How far the stand-in is from the simulator: fixed offsets by level, with signs from a seed."""

from __future__ import annotations

import copy
import dataclasses

import mujoco
import numpy as np

from mjx_arm.options import check_name

_SEED, _TEST_SEED = 1609, 3759


@dataclasses.dataclass(frozen=True)
class Offsets:
    """How the stand-in differs from the simulator.

    Attributes:
      camera_shift: distance by which each camera is moved, m.
      camera_turn: angle by which each camera is turned, degrees.
      colour: the hue is turned by this share of the colour circle, and the brightness is changed
        by this share.
      dynamics: share by which friction and masses are changed.
      servo_gain: share of the servos' gain that is missing.
      image_delay: age of the image that the agent sees, iterations.
      short_step: share of a joint's step that is missing.
      seed: of the directions of all offsets; see `sample_signs`.
    """

    camera_shift: float = 0.0
    camera_turn: float = 0.0
    colour: float = 0.0
    dynamics: float = 0.0
    servo_gain: float = 0.0
    image_delay: int = 0
    short_step: float = 0.0
    seed: int = _SEED


LEVELS = {
    "near": Offsets(0.01, 1.0, 0.05, 0.10, 0.05, 0, 0.0),
    "medium": Offsets(0.03, 3.0, 0.10, 0.20, 0.10, 1, 0.10),
    "far": Offsets(0.06, 6.0, 0.20, 0.40, 0.20, 2, 0.10),
    # For the tests, so that they tell nothing about the other levels.
    "test": Offsets(0.015, 1.5, 0.04, 0.15, 0.07, 1, 0.05, seed=_TEST_SEED),
}
"""The levels by name. `near`, `medium` and `far` share their signs, `test` has others."""


def find_level(name: str) -> Offsets:
    """The offsets of a level.

    Raises:
      ValueError: there is no such level.
    """
    check_name("level", name, LEVELS)
    return LEVELS[name]


@dataclasses.dataclass(frozen=True)
class Signs:
    """The direction of each offset, 1 or -1.

    Attributes:
      shift: `[3] int`, of the cameras' axes.
      turn: `[3] int`, of the axis that the cameras are turned about.
      hue: of the hue.
      brightness: of the brightness.
      friction: of the friction, the same for all contacts.
      masses: `[nbody] int`, of each body's mass.
    """

    shift: np.ndarray
    turn: np.ndarray
    hue: int
    brightness: int
    friction: int
    masses: np.ndarray


def sample_signs(offsets: Offsets, bodies: int) -> Signs:
    """The signs of a level, which depend only on its seed and on the number of bodies."""
    rng = np.random.default_rng(offsets.seed)
    signs = 2 * rng.integers(0, 2, 9 + bodies) - 1
    shift, turn, others, masses = np.split(signs, [3, 6, 9])
    hue, brightness, friction = (int(x) for x in others)
    return Signs(shift, turn, hue, brightness, friction, masses)


def offset_model(model: mujoco.MjModel, offsets: Offsets) -> mujoco.MjModel:
    """A copy of a model with the offsets of its cameras, contacts, masses and servos.

    A camera is moved along a diagonal of the frame of its body, and turned about a diagonal of its
    own frame: `camera_shift` and `camera_turn` are the whole distance and the whole angle.
    """
    model = copy.copy(model)
    signs = sample_signs(offsets, model.nbody)
    model.cam_pos[:] += offsets.camera_shift * signs.shift / np.sqrt(3)
    turn = np.zeros(4)
    axis = signs.turn / np.sqrt(3)
    mujoco.mju_axisAngle2Quat(turn, axis, np.deg2rad(offsets.camera_turn))
    for camera in range(model.ncam):
        turned = np.zeros(4)
        mujoco.mju_mulQuat(turned, model.cam_quat[camera], turn)
        model.cam_quat[camera] = turned
    friction = 1 + signs.friction * offsets.dynamics
    model.geom_friction[:] *= friction
    model.pair_friction[:] *= friction
    masses = 1 + signs.masses * offsets.dynamics
    model.body_mass[:] *= masses
    model.body_inertia[:] *= masses[:, None]
    # A position servo pulls by gain * (command - position): both terms have the gain.
    gain = 1 - offsets.servo_gain
    model.actuator_gainprm[:, 0] *= gain
    model.actuator_biasprm[:, 1] *= gain
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def colour_matrix(offsets: Offsets, bodies: int) -> np.ndarray:
    """The matrix that colours (red, green, blue) are multiplied by, `[3, 3] float32`.

    The hue is turned about the axis of the greys.
    """
    signs = sample_signs(offsets, bodies)
    angle = 2 * np.pi * offsets.colour * signs.hue
    axis = np.ones(3) / np.sqrt(3)
    cross = np.asarray([[0, -1, 1], [1, 0, -1], [-1, 1, 0]]) / np.sqrt(3)
    turn = np.eye(3) * np.cos(angle) + cross * np.sin(angle)
    turn = turn + np.outer(axis, axis) * (1 - np.cos(angle))
    return ((1 + offsets.colour * signs.brightness) * turn).astype(np.float32)
