"""A clock that tests wind, and a robot of an arm with two joints, outside of the package."""

from __future__ import annotations

import threading
from collections.abc import Callable

import numpy as np

from mjx_arm.deploy.robot import Frame, RobotError

SHAPE = (4, 6, 3)


class SimulatedClock:
    """Time passes only by waiting, and by what the robot and the policy say that they take."""

    def __init__(self) -> None:
        self.time = 100.0
        self.waits: list[float] = []

    def now(self) -> float:
        return self.time

    def wait_until(self, when: float, stop: threading.Event) -> None:
        self.waits.append(when)
        self.time = max(self.time, when)

    def pass_(self, seconds: float) -> None:
        self.time += seconds


class Thinker:
    """A policy that takes a time, and gives the actions of a list."""

    image_shape = SHAPE
    num_actions = 6

    def __init__(self, clock: SimulatedClock, actions: list[int], takes: float = 0.002) -> None:
        self.clock, self.actions, self.takes = clock, actions, takes
        self.asked = -1  # the first question only warms it up

    def __call__(self, image: np.ndarray) -> tuple[np.ndarray, int]:
        assert image.shape == SHAPE
        self.asked += 1
        self.clock.pass_(self.takes)
        action = self.actions[max(self.asked - 1, 0) % len(self.actions)]
        return np.eye(6, dtype=np.float32)[action], action


class TwoJoints:
    """A robot that does as it is told, but for what a test makes of a method."""

    def __init__(self, clock: SimulatedClock) -> None:
        self.clock = clock
        self.angles = np.asarray([0.0, 10.0])
        self.told: list[tuple] = []
        self.frames = 0
        self.make_frame: Callable[[int], Frame] = self.good_frame
        self.make_angles: Callable[[], object] = lambda: self.angles.copy()
        self.gone_after: float = float("inf")

    def good_frame(self, number: int) -> Frame:
        return Frame(np.full(SHAPE, number % 256, np.uint8), self.clock.now(), number)

    def frame(self) -> Frame:
        self.frames += 1
        return self.make_frame(self.frames)

    def joint_angles(self) -> np.ndarray:
        return self.make_angles()  # type: ignore[return-value]

    def _tell(self, *words: object) -> None:
        if len(self.told) >= self.gone_after:
            raise RobotError("the robot is gone")
        self.told.append(words)

    def move_joint(self, joint: int, degrees: float) -> None:
        self._tell("move", joint, degrees)
        self.angles[joint] += degrees

    def open(self) -> None:
        self._tell("open")

    def close(self) -> None:
        self._tell("close")

    def stop(self) -> None:
        self._tell("stop")
