"""The stand-in as a `Robot`: the client of its process."""

from __future__ import annotations

import contextlib
import math
import socket
import threading
import time
from types import TracebackType
from typing import Any

import numpy as np

from mjx_arm.deploy.robot import Frame, RobotError
from mjx_arm.deploy.wire import LOOPBACK, ClosedError, GarbageError, receive, send

# The stand-in greets, sends its first image and resets within this time, s.
_PATIENCE = 5.0


class StandInRobot:
    """Drives a stand-in that listens on a port of this machine; use it in a `with` block.

    An image's time is the one at which it has arrived, on the clock of `time.monotonic`.

    Args:
      port: of the stand-in.

    Attributes:
      hello: what the stand-in says of itself: names of the `joints`, `step` in degrees, number of
        `starts`.
      received: number of images that have arrived.
      sent: number of images that the stand-in has taken since the first one that arrived.

    Raises:
      RobotError: nothing listens there, or not a stand-in, or it has another client already.
    """

    def __init__(self, port: int) -> None:
        try:
            self._socket = socket.create_connection((LOOPBACK, port), _PATIENCE)
        except (OSError, OverflowError) as error:
            raise RobotError(f"no stand-in listens on port {port} of {LOOPBACK}") from error
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        try:
            self.hello = self._greet()
        except RobotError:
            self._socket.close()
            raise
        self._socket.settimeout(None)
        self._lock = threading.Condition()
        self._error = ""
        self._frame: Frame | None = None
        self._state: dict[str, Any] = {}
        self.received = self.sent = 0
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _greet(self) -> dict[str, Any]:
        try:
            hello, _ = receive(self._socket)
        except (ClosedError, GarbageError) as error:
            raise RobotError(f"what listens there is no stand-in: {error}") from error
        if hello["kind"] == "error":
            raise RobotError(f"the stand-in reports an error: {hello.get('sentence')}")
        if hello["kind"] != "hello":
            raise RobotError(f"the stand-in begins with {hello['kind']!r} instead of a hello")
        return hello

    def _read(self) -> None:
        """Keeps the newest state, until the connection ends."""
        first = None
        try:
            while True:
                state, data = receive(self._socket)
                arrived = time.monotonic()
                if state["kind"] == "error":
                    raise GarbageError(f"the stand-in reports an error: {state.get('sentence')}")
                frame = _frame(state, data, arrived)
                with self._lock:
                    first = frame.number if first is None else first
                    self._frame, self._state = frame, state
                    self.received, self.sent = self.received + 1, frame.number - first + 1
                    self._lock.notify_all()
        except (ClosedError, GarbageError) as error:
            gone = f"the stand-in is gone: {error}"
            with self._lock:
                self._error = str(error) if isinstance(error, GarbageError) else gone
                self._lock.notify_all()

    def _check(self) -> None:
        if self._error:
            raise RobotError(self._error)

    def frame(self) -> Frame:
        """The newest image; see `Robot`."""
        with self._lock:
            self._lock.wait_for(lambda: self._frame is not None or self._error, _PATIENCE)
            self._check()
            if self._frame is None:
                raise RobotError("the camera is silent: the stand-in has sent no image")
            return self._frame

    def joint_angles(self) -> np.ndarray:
        """Angles that came with the newest image, `[n] float64`, degrees."""
        with self._lock:
            self._check()
            try:
                return np.asarray(self._state["joints"], np.float64)
            except (KeyError, ValueError, TypeError) as error:
                raise RobotError("the stand-in reports no joint angles") from error

    def measured(self, name: str) -> Any:
        """What the stand-in knows and a real arm does not.

        Args:
          name: `success` or `grasped`, bool, or `episode`, the number of resets.

        Returns:
          The value that came with the newest image; None before the first.

        Raises:
          RobotError: the connection has ended.
        """
        with self._lock:
            self._check()
            return self._state.get(name)

    def move_joint(self, joint: int, degrees: float) -> None:
        """See `Robot`."""
        self._command(kind="move", joint=joint, degrees=degrees)

    def open(self) -> None:
        """See `Robot`."""
        self._command(kind="open")

    def close(self) -> None:
        """See `Robot`."""
        self._command(kind="close")

    def stop(self) -> None:
        """See `Robot`."""
        self._command(kind="stop")

    def reset(self, start: int) -> None:
        """Puts arm and cube to a start, and waits until an image shows it.

        Args:
          start: 0 to `hello["starts"] - 1`.

        Raises:
          RobotError: the stand-in does not do so within 5 s, or the connection has ended.
        """
        with self._lock:
            self._check()
            episode = self._state.get("episode", 0)
        self._command(kind="reset", start=start)
        with self._lock:
            seen = self._lock.wait_for(
                lambda: self._error or self._state.get("episode", 0) > episode, _PATIENCE
            )
            self._check()
            if not seen:
                raise RobotError("the stand-in does not go to another start")

    def _command(self, **values: Any) -> None:
        with self._lock:
            self._check()
        try:
            send(self._socket, values)
        except ClosedError as error:
            with self._lock:
                self._check()
            raise RobotError(f"the stand-in is gone: {error}") from error

    def disconnect(self) -> None:
        """Ends the connection; the arm stops."""
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()
        self._reader.join(_PATIENCE)

    def __enter__(self) -> StandInRobot:
        """Returns the robot."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Ends the connection."""
        self.disconnect()


def _frame(state: dict[str, Any], data: bytes, arrived: float) -> Frame:
    """The image of a state.

    Raises:
      GarbageError: it has none.
    """
    shape, number = state.get("shape"), state.get("number")
    if (
        not isinstance(shape, list)
        or not all(type(x) is int and x > 0 for x in shape)
        or math.prod(shape) != len(data)
    ):
        raise GarbageError("the stand-in sends an image of another size than it says")
    if type(number) is not int:
        raise GarbageError("the stand-in sends an image without a number")
    return Frame(np.frombuffer(data, np.uint8).reshape(shape), arrived, number)
