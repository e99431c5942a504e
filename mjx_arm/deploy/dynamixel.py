"""A real arm of Dynamixel servos, such as the ViperX 300, and a webcam.

Addresses and units are those of the X series under protocol 2.0 (ROBOTIS e-Manual, XM430-W350 and
XM540-W270). Ids are those of the maker's configuration of the ViperX 300 6DOF: shoulder and elbow
have a second servo each, which follows the first by its `Secondary ID` and is not addressed.

Nothing is written to a servo's EEPROM. The adapter was tested with an emulator of the protocol, and
not with an arm.
"""

from __future__ import annotations

import functools
import json
import pathlib
from collections.abc import Callable
from types import TracebackType
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from mjx_arm.deploy.robot import Frame, RobotError, first_line
from mjx_arm.options import Count, from_json, options

# Control table: address and length in bytes.
_OPERATING_MODE = (11, 1)
_TORQUE_ENABLE = (64, 1)
_HARDWARE_ERROR = (70, 1)
_GOAL_CURRENT = (102, 2)
_PROFILE_ACCELERATION = (108, 4)
_PROFILE_VELOCITY = (112, 4)
_GOAL_POSITION = (116, 4)
_PRESENT_POSITION = (132, 4)

# Operating modes: position; current-based position, in which a gripper holds with limited force.
_POSITION, _CURRENT_POSITION = 3, 5
_TICKS = 4096 / 360.0
_ALERT = 0x80
# Bits of the hardware error status.
_ERRORS = {
    0: "input voltage",
    2: "overheating",
    3: "encoder",
    4: "electrical shock",
    5: "overload",
}
# Attempts at a transfer: one byte in a million is wrong on a good line.
_TRIES = 2
# A joint that is further behind its target than this has hit something, degrees.
_MOST_BEHIND = 10.0

ServoId = Annotated[int, Field(ge=0, le=252)]
# Positions that the servos know: 256 turns in both directions.
Ticks = Annotated[int, Field(ge=-(2**20) + 1, le=2**20 - 1)]
# The largest limit of the current of an XM540-W270; a servo with a lower one rejects the value.
Current = Annotated[int, Field(ge=1, le=2047)]
Profile = Annotated[int, Field(ge=0, le=32767)]


@options
class DynamixelConfig:
    """An arm of Dynamixel servos, from a JSON file.

    Attributes:
      port: serial device, such as `/dev/ttyUSB0`.
      baudrate: of the bus.
      joints: ids of the servos of the joints, in the order of the scene.
      signs: for each joint 1 if the servo's position rises with the scene's angle, else -1.
      zeros: positions of the servos where the scene's angles are 0, ticks of 360/4096 degrees.
      gripper: id of the gripper's servo.
      gripper_open: its position when the gripper is open, ticks.
      gripper_closed: its position when the gripper is shut, ticks.
      gripper_current: limit of its current in the current-based position mode, units of 2.69 mA.
      profile_velocity: limit of the joints' speed, units of 0.229 rev/min; 0 for no limit.
      profile_acceleration: limit of the joints' acceleration, units of 214.577 rev/min2; 0 for no
        limit.
      camera: path of a video device, or of a video.
    """

    port: str = "/dev/ttyUSB0"
    baudrate: Count = 1_000_000
    joints: tuple[ServoId, ...] = (1, 2, 4, 6, 7, 8)
    signs: tuple[int, ...] = (1, 1, 1, 1, 1, 1)
    zeros: tuple[Ticks, ...] = (2048, 2048, 2048, 2048, 2048, 2048)
    gripper: ServoId = 9
    gripper_open: Ticks
    gripper_closed: Ticks
    gripper_current: Current = 200
    profile_velocity: Profile = 60
    profile_acceleration: Profile = 30
    camera: str = "/dev/video0"

    def check(self) -> None:
        """Rejects lists that are empty or of different lengths, and ids that occur twice."""
        lengths = {len(x) for x in (self.joints, self.signs, self.zeros)}
        if len(lengths) != 1 or not self.joints:
            raise ValueError(
                "joints, signs and zeros must have one value for each joint, and at least one, got "
                f"{len(self.joints)}, {len(self.signs)} and {len(self.zeros)}"
            )
        if not set(self.signs) <= {1, -1}:
            raise ValueError(f"signs must be 1 or -1, got {list(self.signs)}")
        if len({*self.joints, self.gripper}) != len(self.joints) + 1:
            raise ValueError("joints and gripper must name each servo once")


def read_config(path: pathlib.Path) -> DynamixelConfig:
    """Reads the file of an arm.

    Raises:
      ValueError: the file is missing or invalid.
    """
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ValueError(f"{path} cannot be read: {error.strerror}") from error
    except ValueError as error:
        raise ValueError(f"{path} is no JSON: {error}") from error
    return from_json(DynamixelConfig, values, str(path))


class DynamixelRobot:
    """Drives an arm of Dynamixel servos; see `Robot`. Use it in a `with` block.

    Making one turns the torque of all servos on, and they hold where they are. This also happens in
    a dry run. At the end of the block they keep holding: without torque the arm would fall.

    Args:
      config: of the arm.
      frame: gives the newest image, as `mjx_arm.deploy.camera.VideoCamera.frame`.
      limits: `[n, 2] float64`, degrees, which no target of a joint leaves, as `Guard.limits`. The
        guard knows where a joint is, and its target may be some degrees ahead of that.
      tries: attempts at a transfer.

    Raises:
      RobotError: the port cannot be opened, a servo does not answer or reports a fault, or its
        operating mode is wrong.
      ValueError: dynamixel-sdk is not installed.
    """

    def __init__(
        self,
        config: DynamixelConfig,
        frame: Callable[[], Frame],
        limits: np.ndarray,
        *,
        tries: int = _TRIES,
    ) -> None:
        try:
            import dynamixel_sdk
        except ImportError as error:
            raise ValueError(
                "an arm of Dynamixel servos needs dynamixel-sdk: pip install 'mjx_arm[deploy]'"
            ) from error
        self._sdk: Any = dynamixel_sdk
        if np.shape(limits) != (len(config.joints), 2):
            raise ValueError(
                f"limits must be a lower and an upper one of {len(config.joints)} joints, got the "
                f"shape {np.shape(limits)}"
            )
        self.config, self._frame, self._limits, self._tries = config, frame, limits, tries
        self._signs = np.asarray(config.signs, np.float64)
        self._zeros = np.asarray(config.zeros, np.float64)
        self._packets = dynamixel_sdk.PacketHandler(2.0)
        self._port = dynamixel_sdk.PortHandler(config.port)
        self._open_port()
        try:
            self._find_servos()
            self._targets = self._read_angles()
            self._prepare()
        except BaseException:
            self._port.closePort()
            raise

    def _open_port(self) -> None:
        self._port.baudrate = self.config.baudrate
        try:
            opened = self._port.openPort()
        except Exception as error:  # pyserial's, and those of the system
            raise RobotError(
                f"the port {self.config.port} cannot be opened: {first_line(error)}"
            ) from error
        if not opened:
            raise RobotError(f"the port {self.config.port} has no rate of {self.config.baudrate}")

    def _find_servos(self) -> None:
        config = self.config
        for servo in (*config.joints, config.gripper):
            self._ask(servo, "ping")
            self._check_hardware(servo)
            mode = self._read(servo, _OPERATING_MODE)
            allowed = (_POSITION, _CURRENT_POSITION) if servo == config.gripper else (_POSITION,)
            if mode not in allowed:
                names = " or ".join(map(str, allowed))
                raise RobotError(f"{self._name(servo)} is in operating mode {mode}, set {names}")

    def _prepare(self) -> None:
        """Limits speed, then holds: a goal from an earlier use would make the arm jump."""
        config = self.config
        for joint, servo in enumerate(config.joints):
            self._write(servo, _PROFILE_ACCELERATION, config.profile_acceleration)
            self._write(servo, _PROFILE_VELOCITY, config.profile_velocity)
            self._write(servo, _GOAL_POSITION, self._ticks(joint))
            self._write(servo, _TORQUE_ENABLE, 1)
        self._write(config.gripper, _GOAL_CURRENT, config.gripper_current)
        position = self._read(config.gripper, _PRESENT_POSITION)
        self._write(config.gripper, _GOAL_POSITION, position)
        self._write(config.gripper, _TORQUE_ENABLE, 1)

    def frame(self) -> Frame:
        """The newest image; see `Robot`."""
        return self._frame()

    def joint_angles(self) -> np.ndarray:
        """Angles of the joints, `[n] float64`, degrees; see `Robot`.

        Raises:
          RobotError: a servo does not answer, reports a fault, or is far behind its target.
        """
        angles = self._read_angles()
        behind = np.abs(angles - self._targets)
        joint = int(behind.argmax())
        if behind[joint] > _MOST_BEHIND:
            raise RobotError(
                f"{self._name(self.config.joints[joint])} is {behind[joint]:.0f} degrees behind "
                "its target: it may have hit something"
            )
        return angles

    def move_joint(self, joint: int, degrees: float) -> None:
        """See `Robot`."""
        low, high = self._limits[joint]
        was = self._targets[joint]
        # A joint that begins beyond its range may only come back.
        self._targets[joint] = np.clip(was + degrees, min(low, was), max(high, was))
        self._write(self.config.joints[joint], _GOAL_POSITION, self._ticks(joint))

    def open(self) -> None:
        """See `Robot`."""
        self._write(self.config.gripper, _GOAL_POSITION, self.config.gripper_open)

    def close(self) -> None:
        """See `Robot`."""
        self._write(self.config.gripper, _GOAL_POSITION, self.config.gripper_closed)

    def stop(self) -> None:
        """See `Robot`. Each servo that can be reached holds where it is.

        Raises:
          RobotError: a servo could not be told.
        """
        failed: list[str] = []
        for joint, servo in enumerate(self.config.joints):
            try:
                position = self._read(servo, _PRESENT_POSITION, alert=False)
                self._write(servo, _GOAL_POSITION, position, alert=False)
                self._targets[joint] = self._angle(joint, position)
            except RobotError as error:
                failed.append(str(error))
        if failed:
            # A port that has failed gives the same sentence for each servo.
            raise RobotError("; ".join(dict.fromkeys(failed)))

    def disconnect(self) -> None:
        """Frees the port; the servos hold."""
        self._port.closePort()

    def __enter__(self) -> DynamixelRobot:
        """Returns the robot."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Frees the port."""
        self.disconnect()

    def _read_angles(self) -> np.ndarray:
        """All joints by one request, each servo answering in turn."""
        servos, result = self.config.joints, self._sdk.COMM_RX_FAIL
        for _ in range(self._tries):
            positions, result, alerts = self._read_together()
            if result == self._sdk.COMM_SUCCESS:
                for servo in alerts:
                    self._check_hardware(servo)
                return np.asarray([self._angle(j, x) for j, x in enumerate(positions)])
        # Only its own silence says which one it is.
        for servo in servos:
            self._read(servo, _PRESENT_POSITION)
        raise RobotError(f"the servos {list(servos)} do not answer together: {_words(result)}")

    def _read_together(self) -> tuple[list[int], int, list[int]]:
        """Positions, the result, and the servos that report a fault, of one request."""
        address, size = _PRESENT_POSITION
        # Of the SDK's group only the request: its answers lack the byte that reports a fault.
        group = self._sdk.GroupSyncRead(self._port, self._packets, address, size)
        for servo in self.config.joints:
            group.addParam(servo)
        positions: list[int] = []
        alerts: list[int] = []
        result = self._guarded(group.txPacket)
        for servo in self.config.joints:
            if result != self._sdk.COMM_SUCCESS:
                break
            receive = functools.partial(self._packets.readRx, self._port, servo, size)
            data, result, error = self._guarded(receive)
            positions.append(int.from_bytes(bytes(data[:size]), "little", signed=True))
            if error & _ALERT:
                alerts.append(servo)
        return positions, result, alerts

    def _angle(self, joint: int, position: int) -> float:
        return float(self._signs[joint] * (position - self._zeros[joint]) / _TICKS)

    def _ticks(self, joint: int) -> int:
        return round(float(self._zeros[joint] + self._signs[joint] * self._targets[joint] * _TICKS))

    def _try(self, transfer: Callable[[], Any]) -> Any:
        """The result of a transfer, a tuple that ends in result and error."""
        answer: Any = None
        for _ in range(self._tries):
            answer = self._guarded(transfer)
            if answer[-2] == self._sdk.COMM_SUCCESS:
                break
        return answer

    def _guarded(self, transfer: Callable[[], Any]) -> Any:
        try:
            return transfer()
        except Exception as error:  # pyserial's and the system's, where the cable is pulled
            raise RobotError(
                f"the port {self.config.port} has failed: {first_line(error)}"
            ) from error

    def _ask(self, servo: int, name: str, *arguments: int, alert: bool = True) -> Any:
        """A transfer with one servo, by the name of the method of dynamixel-sdk."""
        call = getattr(self._packets, name)
        answer = self._try(lambda: call(self._port, servo, *arguments))
        result, error = answer[-2:]
        if result != self._sdk.COMM_SUCCESS:
            raise RobotError(f"{self._name(servo)} does not answer: {_words(result)}")
        if error & _ALERT and alert:
            self._check_hardware(servo)
        if error & ~_ALERT:
            words = self._packets.getRxPacketError(error & ~_ALERT).split("] ")[-1].rstrip("!.")
            raise RobotError(f"{self._name(servo)} reports an error: {words}")
        return answer[0]

    def _read(self, servo: int, field: tuple[int, int], *, alert: bool = True) -> int:
        address, size = field
        value = self._ask(servo, f"read{size}ByteTxRx", address, alert=alert)
        return _signed(value) if size == 4 else int(value)

    def _write(self, servo: int, field: tuple[int, int], value: int, *, alert: bool = True) -> None:
        address, size = field
        # Two's complement, which the SDK does not make of negative numbers.
        self._ask(servo, f"write{size}ByteTxRx", address, value & (1 << 8 * size) - 1, alert=alert)

    def _check_hardware(self, servo: int) -> None:
        status = self._read(servo, _HARDWARE_ERROR, alert=False)
        found = [word for bit, word in _ERRORS.items() if status >> bit & 1]
        if status:
            raise RobotError(f"{self._name(servo)} reports a fault: {', '.join(found) or status}")

    def _name(self, servo: int) -> str:
        if servo == self.config.gripper:
            return f"servo {servo} (gripper)"
        return f"servo {servo} (joint {self.config.joints.index(servo)})"


def _signed(value: int) -> int:
    return value - (1 << 32) if value >= 1 << 31 else value


def _words(result: int) -> str:
    words: dict[int, str] = {
        -1000: "the port is in use",
        -1001: "the request could not be sent",
        -1002: "the answer could not be received",
        -3001: "no answer in time",
        -3002: "its answer is damaged",
    }
    return words.get(result, f"error {result}")
