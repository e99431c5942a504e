"""The clock of the control loop, so that tests can have another one."""

from __future__ import annotations

import threading
import time
from typing import Protocol


class Clock(Protocol):
    """A monotonic clock that can wait."""

    def now(self) -> float:
        """The time, s."""
        ...

    def wait_until(self, when: float, stop: threading.Event) -> None:
        """Returns at the time `when`, s, or as soon as `stop` is set."""
        ...


class WallClock:
    """`time.monotonic`, which the stand-in's client and the camera use for their images as well."""

    def now(self) -> float:
        """The time, s."""
        return time.monotonic()

    def wait_until(self, when: float, stop: threading.Event) -> None:
        """Returns at the time `when`, s, or as soon as `stop` is set."""
        left = when - time.monotonic()
        if left > 0:
            stop.wait(left)
