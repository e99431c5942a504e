from __future__ import annotations

import contextlib
import json
import os
import sys
import threading
from collections.abc import Iterator

import numpy as np
import pytest
from dynamixel_emulator import Bus, Servo, checksum
from dynamixel_sdk import port_handler

from mjx_arm.deploy.camera import VideoCamera, scale_down
from mjx_arm.deploy.dynamixel import DynamixelConfig, DynamixelRobot, read_config
from mjx_arm.deploy.robot import Frame, RobotError
from mjx_arm.report.video import write_video

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="pseudo-terminals are of Unix")

JOINTS = (1, 2, 4, 6, 7, 8)
GOAL, PRESENT, TORQUE, ERROR = 116, 132, 64, 70


def frame() -> Frame:
    return Frame(np.zeros((4, 6, 3), np.uint8), 0.0, 1)


def config(port: str, **options) -> DynamixelConfig:
    return DynamixelConfig(port=port, gripper_open=3000, gripper_closed=1500, **options)


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """0.2 s for an answer instead of 34 ms, so that a busy machine's emulator is in time."""
    monkeypatch.setattr(port_handler, "LATENCY_TIMER", 100)


# Of the six joints, degrees.
LIMITS = np.tile([-360.0, 360.0], (6, 1))


@pytest.fixture
def bus() -> Iterator[Bus]:
    servos = {joint: Servo(position=2048 + 10 * joint) for joint in JOINTS}
    with Bus({**servos, 9: Servo(mode=5, position=2500)}) as made:
        yield made


@pytest.fixture
def robot(bus: Bus) -> Iterator[DynamixelRobot]:
    with DynamixelRobot(config(bus.port), frame, LIMITS) as made:
        yield made


def test_the_checksum_is_that_of_the_manual() -> None:
    """The e-Manual's example: ping of id 1."""
    assert checksum(bytes.fromhex("FFFFFD00 01 0300 01")) == 0x4E19


def test_it_holds_where_it_is_when_it_begins(bus, robot) -> None:
    for joint in JOINTS:
        servo = bus.servos[joint]
        assert servo.get(GOAL, 4) == 2048 + 10 * joint
        assert servo.table[TORQUE] == 1
        # The goal is set before the torque: else the arm would jump to an old one.
        addresses = [address for address, _ in servo.writes]
        assert addresses.index(GOAL) < addresses.index(TORQUE)
        assert min(addresses) >= 64  # nothing in the EEPROM
    assert bus.servos[9].get(GOAL, 4) == 2500
    assert bus.servos[9].get(102, 2) == 200


def test_angles_and_steps_are_in_degrees(bus, robot) -> None:
    ticks = 4096 / 360
    expected = [10 * joint / ticks for joint in JOINTS]
    assert robot.joint_angles() == pytest.approx(expected)
    for _ in range(9):
        robot.move_joint(2, -1.0)
    # Rounding does not add up: 9 degrees are 102.4 ticks.
    assert bus.servos[4].get(PRESENT, 4) == round(2048 + 40 - 9 * ticks)
    assert robot.joint_angles()[2] == pytest.approx(expected[2] - 9, abs=0.05)
    robot.open()
    assert bus.servos[9].get(GOAL, 4) == 3000
    robot.close()
    assert bus.servos[9].get(GOAL, 4) == 1500
    assert robot.frame().number == 1


def test_signs_zeros_and_negative_positions(bus) -> None:
    signs, zeros = (1, -1, 1, 1, 1, 1), (2048, 1000, 2048, 2048, 2048, 2048)
    bus.servos[1].set(PRESENT, 4, -3)
    with DynamixelRobot(config(bus.port, signs=signs, zeros=zeros), frame, LIMITS) as robot:
        angles = robot.joint_angles()
        assert angles[0] == pytest.approx((-3 - 2048) * 360 / 4096)
        assert angles[1] == pytest.approx(-(2068 - 1000) * 360 / 4096)
        robot.move_joint(1, 1.0)
        assert bus.servos[2].get(GOAL, 4) == round(2068 - 4096 / 360)
        robot.move_joint(0, -1.0)
        assert bus.servos[1].get(GOAL, 4) == round(-3 - 4096 / 360)


def test_no_target_leaves_the_range_of_its_joint(bus) -> None:
    begins = (2058 - 2048) * 360 / 4096
    limits = LIMITS.copy()
    # The second joint begins beyond its range.
    limits[0], limits[1] = (-360.0, begins + 1.5), (-360.0, 0.0)
    with DynamixelRobot(config(bus.port), frame, limits) as robot:
        for _ in range(4):
            robot.move_joint(0, 1.0)
            robot.move_joint(1, 1.0)
        assert bus.servos[1].get(GOAL, 4) == round(2058 + 1.5 * 4096 / 360)
        assert bus.servos[2].get(GOAL, 4) == 2068
        robot.move_joint(1, -1.0)
        assert bus.servos[2].get(GOAL, 4) == round(2068 - 4096 / 360)


def test_limits_are_those_of_the_joints(bus) -> None:
    with pytest.raises(ValueError, match=r"upper one of 6 joints, got the shape \(2, 2\)"):
        DynamixelRobot(config(bus.port), frame, LIMITS[:2])


def test_one_wrong_checksum_is_asked_again(bus, robot) -> None:
    before = robot.joint_angles()
    bus.damaged = 1
    assert np.array_equal(robot.joint_angles(), before)
    bus.damaged = 1
    robot.move_joint(0, 1.0)
    assert bus.servos[1].get(GOAL, 4) == round(2058 + 4096 / 360)


def test_wrong_checksums_stop_it(bus, robot) -> None:
    bus.damaged = 1000
    with pytest.raises(RobotError, match=r"servo 1 \(joint 0\) does not answer: .* is damaged"):
        robot.joint_angles()
    with pytest.raises(RobotError, match=r"servo 4 \(joint 2\) does not answer: .* is damaged"):
        robot.move_joint(2, 1.0)


def test_a_servo_that_does_not_answer_is_named(bus, robot) -> None:
    bus.silent = {7}
    with pytest.raises(RobotError, match=r"servo 7 \(joint 4\) does not answer: no answer in time"):
        robot.joint_angles()
    with pytest.raises(RobotError, match="servo 7"):
        robot.move_joint(4, 1.0)
    # The others are still told to hold.
    bus.servos[8].stuck = True
    bus.servos[8].set(GOAL, 4, 0)
    with pytest.raises(
        RobotError, match=r"^servo 7 \(joint 4\) does not answer: no answer in time$"
    ):
        robot.stop()
    assert bus.servos[8].get(GOAL, 4) == bus.servos[8].get(PRESENT, 4)


def test_answers_that_are_too_late_are_no_answers(bus, robot) -> None:
    bus.late = 0.5
    with pytest.raises(RobotError, match="no answer in time"):
        robot.open()
    bus.late = 0.0


def test_a_missing_id_is_named_at_the_beginning(bus) -> None:
    del bus.servos[6]
    with pytest.raises(RobotError, match=r"servo 6 \(joint 3\) does not answer"):
        DynamixelRobot(config(bus.port), frame, LIMITS)


@pytest.mark.parametrize(
    ("bits", "words"),
    [(0x20, "overload"), (0x04, "overheating"), (0x21, "input voltage, overload")],
)
def test_a_fault_of_a_servo_is_named(bus, robot, bits, words) -> None:
    bus.servos[2].table[ERROR] = bits
    for call in (robot.joint_angles, lambda: robot.move_joint(1, 1.0)):
        with pytest.raises(RobotError, match=rf"servo 2 \(joint 1\) reports a fault: {words}"):
            call()
    robot.stop()  # holds all the same
    with pytest.raises(RobotError, match="reports a fault"):
        DynamixelRobot(config(bus.port), frame, LIMITS)


def test_a_joint_that_does_not_follow_is_named(bus, robot) -> None:
    bus.servos[6].stuck = True
    for _ in range(9):
        robot.move_joint(3, 1.0)
        robot.joint_angles()
    robot.move_joint(3, 1.0)
    robot.move_joint(3, 1.0)
    with pytest.raises(RobotError, match=r"servo 6 \(joint 3\) is 11 degrees behind its target"):
        robot.joint_angles()
    robot.stop()
    robot.joint_angles()


def test_a_wrong_operating_mode_is_rejected(bus) -> None:
    bus.servos[9].table[11] = 16
    with pytest.raises(
        RobotError, match=r"servo 9 \(gripper\) is in operating mode 16, set 3 or 5"
    ):
        DynamixelRobot(config(bus.port), frame, LIMITS)


def test_a_cable_that_is_pulled_is_one_sentence(bus, robot) -> None:
    bus.pull()
    for call in (robot.joint_angles, robot.open, robot.stop):
        with pytest.raises(RobotError, match=r"has failed|does not answer"):
            call()


def test_a_port_that_has_failed_is_named_once(bus, robot, monkeypatch) -> None:
    def fail(*arguments: object) -> None:
        raise OSError

    monkeypatch.setattr(robot._packets, "txPacket", fail)
    with pytest.raises(RobotError, match=rf"^the port {bus.port} has failed: \w+$"):
        robot.stop()


def test_a_port_that_is_not_there() -> None:
    with pytest.raises(RobotError, match="the port /dev/none cannot be opened"):
        DynamixelRobot(config("/dev/none"), frame, LIMITS)


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        ({"joints": [1, 2]}, "joints, signs and zeros must have one value for each joint"),
        ({"joints": [], "signs": [], "zeros": []}, "and at least one, got 0, 0 and 0"),
        ({"signs": [1, 1, 1, 1, 1, 2]}, "signs must be 1 or -1"),
        ({"gripper": 8}, "must name each servo once"),
        ({"joint": [1]}, "unknown option 'joint': did you mean 'joints'"),
        ({"gripper_open": "wide"}, "gripper_open must be a whole number"),
        ({"gripper_closed": 2**32}, "gripper_closed must be a whole number from -1048575 to"),
        # Its register has 16 bits.
        ({"gripper_current": 2**16 + 200}, "gripper_current must be a whole number from 1 to 2047"),
        ({"baudrate": 0}, "baudrate must be a whole number of at least 1"),
    ],
)
def test_the_file_of_an_arm_is_checked(tmp_path, values, sentence) -> None:
    path = tmp_path / "arm.json"
    path.write_text(json.dumps({"gripper_open": 1, "gripper_closed": 2} | values))
    with pytest.raises(ValueError, match=sentence):
        read_config(path)


def test_the_file_of_an_arm_is_read(tmp_path) -> None:
    path = tmp_path / "arm.json"
    path.write_text(
        '{"gripper_open": 1, "gripper_closed": 2, "joints": [5, 6], "signs": [1, -1], '
        '"zeros": [0, 1]}'
    )
    assert read_config(path).joints == (5, 6)
    path.write_text("{")
    with pytest.raises(ValueError, match="is no JSON"):
        read_config(path)


def wait_for_the_end(camera: VideoCamera) -> None:
    with camera._lock:
        assert camera._lock.wait_for(lambda: camera._error, 60)
    assert camera._error == "it has ended"


def test_a_camera_gives_what_the_agent_sees(tmp_path) -> None:
    video = tmp_path / "camera.mp4"
    grey = [np.full((96, 128, 3), value, np.uint8) for value in (40, 80, 120)]
    write_video(video, grey)
    camera = VideoCamera(str(video), (8, 8))
    first = camera.frame()
    assert first.image.shape == (8, 8, 3)
    assert first.image.dtype == np.uint8
    wait_for_the_end(camera)
    camera.close()
    assert camera.frame().image.mean() == pytest.approx(120, abs=6)
    with pytest.raises(RobotError, match=r"none\.mp4' cannot be read: .*No such file") as error:
        VideoCamera(str(tmp_path / "none.mp4"), (8, 8))
    assert "\n" not in str(error.value)


def test_a_camera_that_hangs_keeps_no_process(tmp_path) -> None:
    path, ended = tmp_path / "camera.y4m", threading.Event()
    os.mkfifo(path)

    def film() -> None:
        with contextlib.suppress(BrokenPipeError), path.open("wb") as file:
            file.write(b"YUV4MPEG2 W16 H16 F25:1 C420\n" + (b"FRAME\n" + bytes(384)) * 200)
            file.flush()
            ended.wait(60)

    thread = threading.Thread(target=film)
    thread.start()
    camera = VideoCamera(str(path), (8, 8))
    assert camera.frame().image.shape == (8, 8, 3)
    camera.close()
    assert camera._process.returncode is not None
    ended.set()
    thread.join()


def test_an_image_is_cut_to_its_middle_and_averaged() -> None:
    image = np.zeros((4, 8, 3), np.uint8)
    image[:, 2:4], image[:, 4:6] = 100, 200
    image[:2, 2] = 50
    assert scale_down(image, (2, 2))[..., 0].tolist() == [[75, 200], [100, 200]]
