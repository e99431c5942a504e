"""What the control loop needs of a robot: a camera, joints in degrees, and a gripper."""

from __future__ import annotations

import dataclasses
from typing import Protocol

import numpy as np


class RobotError(ValueError):
    """The robot, its camera or the line to it has failed; the message is one sentence."""


def first_line(error: Exception) -> str:
    """The first line of an error's message, or the name of its type if the message is empty."""
    return (str(error).splitlines() or [type(error).__name__])[0]


@dataclasses.dataclass(frozen=True)
class Frame:
    """An image and its time.

    Attributes:
      image: `[H, W, 3] uint8`, red, green, blue; of several cameras `[C, H, W, 3]`.
      time: when it was taken, or as near to that as is known, s, on the loop's clock.
      number: rises with every new image.
    """

    image: np.ndarray
    time: float
    number: int


class Robot(Protocol):
    """An arm of n hinges with a gripper and a camera. Every method may raise `RobotError`."""

    def frame(self) -> Frame:
        """The newest image, at once; the first call waits until there is one."""
        ...

    def joint_angles(self) -> np.ndarray:
        """Angles of the joints, `[n] float64`, degrees."""
        ...

    def move_joint(self, joint: int, degrees: float) -> None:
        """Moves the target of a joint, 0 to n - 1, by a step in degrees; does not wait for it."""
        ...

    def open(self) -> None:
        """Opens the gripper; does not wait for it."""
        ...

    def close(self) -> None:
        """Closes the gripper; does not wait for it."""
        ...

    def stop(self) -> None:
        """Makes the joints hold where they are. The gripper keeps its command."""
        ...
