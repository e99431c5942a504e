"""The stand-in's socket; its arm is not needed for most of it."""

from __future__ import annotations

import json
import os
import signal
import socket
import struct
import threading
import time

import numpy as np
import pytest

from mjx_arm.cli import main
from mjx_arm.deploy.log import read_log
from mjx_arm.deploy.robot import RobotError
from mjx_arm.deploy.standin_robot import StandInRobot
from mjx_arm.deploy.standin_server import Server, StandInProcess
from mjx_arm.deploy.wire import LOOPBACK, ClosedError, GarbageError, receive, send
from mjx_arm.standin.levels import find_level
from mjx_arm.tools.transfer import sample_starts
from mjx_arm.training.agent import load_agent

HELLO = {"joints": ["one", "two"], "step": 1.0, "starts": 3}
IMAGE = np.arange(24, dtype=np.uint8).reshape(2, 4, 3)


@pytest.fixture
def server():
    made = Server(HELLO)
    yield made
    made.close()


def state(number: int, **more) -> dict:
    return {"number": number, "joints": [1.0, 2.0], "success": False, "episode": 0, **more}


def wait_for(condition) -> None:
    deadline = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.002)


def commands(server: Server, count: int) -> list[dict]:
    found: list[dict] = []

    def enough() -> bool:
        found.extend(server.take_commands())
        return len(found) >= count

    wait_for(enough)
    return found


def connect(server: Server) -> StandInRobot:
    """A client that has its first image."""
    robot = StandInRobot(server.port)

    def arrived() -> bool:
        server.publish(state(1), IMAGE)
        return robot.received > 0

    wait_for(arrived)
    return robot


def test_images_and_angles_arrive_and_commands_leave(server) -> None:
    with connect(server) as robot:
        assert robot.hello["joints"] == ["one", "two"]
        assert np.array_equal(robot.frame().image, IMAGE)
        assert robot.joint_angles().tolist() == [1.0, 2.0]
        assert robot.measured("success") is False
        robot.move_joint(1, -1.0)
        robot.open()
        robot.close()
        robot.stop()
        kinds = [command["kind"] for command in commands(server, 4)]
        assert kinds == ["move", "open", "close", "stop"]
    # Whoever goes leaves an arm that has stopped.
    assert commands(server, 1) == [{"kind": "stop"}]


def test_it_listens_on_the_loopback_interface_alone(server) -> None:
    assert server._listener.getsockname()[0] == LOOPBACK == "127.0.0.1"


def test_a_second_client_is_rejected_and_the_first_one_goes_on(server) -> None:
    with connect(server) as robot:
        with pytest.raises(RobotError, match="reports an error: another client drives this arm"):
            StandInRobot(server.port)
        robot.open()
        assert commands(server, 1) == [{"kind": "open"}]
    commands(server, 1)
    connect(server).disconnect()  # the place is free again


@pytest.mark.parametrize(
    ("data", "sentence"),
    [
        (b"GET / HTTP/1.1\r\n\r\n", "garbage came over the socket"),
        pytest.param(bytes(range(256)) * 16, "garbage came over the socket", id="noise"),
        (struct.pack("!4sII", b"MJXA", 4, 0) + b"\xff\xfe{}", "garbage came over the socket"),
        (struct.pack("!4sII", b"MJXA", 2**31, 0), "garbage came over the socket"),
        pytest.param(
            struct.pack("!4sII", b"MJXA", 60_000, 0) + b"[" * 60_000,
            "garbage came over the socket",
            id="nested",
        ),
        (struct.pack("!4sII", b"MJXA", 2, 0) + b"{}", "a message without a kind"),
        ({"kind": "fly"}, "a command is of the kind 'fly'"),
        ({"kind": "move", "joint": 2, "degrees": 1.0}, "a command names the joint 2"),
        ({"kind": "move", "joint": 0, "degrees": 90.0}, "moves a joint by 90.0 degrees instead"),
        ({"kind": "move", "joint": 0, "degrees": float("nan")}, "moves a joint by nan degrees"),
        ({"kind": "move", "joint": 0, "degrees": True}, "moves a joint by True degrees"),
        pytest.param(
            {"kind": "move", "joint": 0, "degrees": 10**400}, "moves a joint by 1000", id="huge"
        ),
        ({"kind": "move", "joint": True, "degrees": 1.0}, "a command names the joint True"),
        ({"kind": "reset", "start": 3}, "a command names the start 3"),
    ],
)
def test_garbage_stops_the_arm(server, data, sentence) -> None:
    with socket.create_connection((LOOPBACK, server.port), 10) as client:
        assert receive(client)[0]["kind"] == "hello"
        if isinstance(data, bytes):
            client.sendall(data)
        else:
            send(client, data)
        assert commands(server, 1) == [{"kind": "stop"}]
        message, _ = receive(client)
        assert message["kind"] == "error"
        assert sentence in message["sentence"]
        assert message["sentence"].endswith("the arm has stopped")
        with pytest.raises(ClosedError):
            receive(client)
    with connect(server) as robot:
        robot.open()
        assert commands(server, 1) == [{"kind": "open"}]


def test_a_slow_client_loses_images_and_keeps_the_newest(server) -> None:
    """The client that reads nothing does not hold up the arm."""
    large = np.zeros((512, 512, 3), np.uint8)
    with socket.create_connection((LOOPBACK, server.port), 10) as client:
        receive(client)
        began = time.monotonic()
        for number in range(300):
            server.publish(state(number), large)
        assert time.monotonic() - began < 5
        numbers = []
        while not numbers or numbers[-1] != 299:
            numbers.append(receive(client)[0]["number"])
    assert len(numbers) < 300
    assert numbers == sorted(numbers)


@pytest.fixture
def liar():
    """A listener that is no stand-in, or one that goes wrong."""
    with socket.create_server((LOOPBACK, 0)) as listener:
        yield listener


def accept(listener: socket.socket) -> socket.socket:
    return listener.accept()[0]


def lying_client(liar: socket.socket) -> tuple[StandInRobot, socket.socket]:
    # The hello is in the client's buffer before it connects.
    sockets: list[socket.socket] = []

    def greet() -> None:
        sockets.append(accept(liar))
        send(sockets[0], {"kind": "hello", **HELLO})

    thread = threading.Thread(target=greet)
    thread.start()
    robot = StandInRobot(liar.getsockname()[1])
    thread.join()
    return robot, sockets[0]


@pytest.mark.parametrize(
    ("message", "sentence"),
    [
        (b"x" * 100, "garbage came over the socket"),
        (({"kind": "state", "shape": [2, 4, 3], "number": 1}, b"short"), "of another size"),
        (({"kind": "state", "shape": [8], "number": "1"}, b"12345678"), "without a number"),
        (({"kind": "error", "sentence": "no more"}, b""), "the stand-in reports an error: no more"),
    ],
)
def test_garbage_from_the_robot_is_one_sentence(liar, message, sentence) -> None:
    robot, sock = lying_client(liar)
    if isinstance(message, bytes):
        sock.sendall(message)
    else:
        send(sock, *message)
    with pytest.raises(RobotError, match=sentence):
        robot.frame()
    with pytest.raises(RobotError, match=sentence):
        robot.move_joint(0, 1.0)
    robot.disconnect()
    sock.close()


def test_a_robot_that_goes_is_one_sentence(liar) -> None:
    robot, sock = lying_client(liar)
    send(sock, {"kind": "state", "shape": [2, 4, 3], "number": 1, "joints": "x"}, IMAGE.tobytes())
    assert robot.frame().number == 1
    with pytest.raises(RobotError, match="reports no joint angles"):
        robot.joint_angles()
    sock.close()
    wait_for(lambda: robot._error)
    for method in (robot.frame, robot.joint_angles, robot.open, robot.stop):
        with pytest.raises(RobotError, match="the stand-in is gone"):
            method()
    robot.disconnect()


def test_nothing_listens() -> None:
    with socket.create_server((LOOPBACK, 0)) as listener:
        port = listener.getsockname()[1]
    with pytest.raises(RobotError, match=f"no stand-in listens on port {port}"):
        StandInRobot(port)
    with pytest.raises(RobotError, match="no stand-in listens on port 99999"):
        StandInRobot(99_999)


def test_a_port_that_is_taken_is_rejected(server) -> None:
    with pytest.raises(ValueError, match=f"port {server.port} of 127.0.0.1 cannot be listened on"):
        Server(HELLO, server.port)


def test_after_the_end_nothing_listens() -> None:
    ended = Server(HELLO)
    ended.close()
    with pytest.raises(RobotError, match=f"no stand-in listens on port {ended.port}"):
        StandInRobot(ended.port)


def test_messages_are_framed() -> None:
    one, other = socket.socketpair()
    with one, other:
        send(one, {"kind": "x", "y": [1, 2]}, b"123")
        assert receive(other) == ({"kind": "x", "y": [1, 2]}, b"123")
        one.sendall(b"MJXB" + bytes(8))
        with pytest.raises(GarbageError):
            receive(other)
        one.sendall(b"MJ")
        one.close()
        with pytest.raises(ClosedError):
            receive(other)


@pytest.fixture(scope="module")
def agent():
    return load_agent("agent-a")


@pytest.mark.slow
@pytest.mark.usefixtures("opengl")
def test_the_process_runs_in_real_time_and_holds(agent) -> None:
    starts = sample_starts(agent.env, 1, 2)
    with (
        StandInProcess(agent.env, find_level("test"), starts) as process,
        StandInRobot(process.port) as robot,
    ):
        before = robot.frame()
        angles = robot.joint_angles()
        time.sleep(1.0)
        after = robot.frame()
        # 50 a second, less on a machine that does other things.
        assert 5 <= after.number - before.number <= 60
        assert robot.joint_angles() == pytest.approx(angles, abs=0.5)
        for _ in range(5):
            robot.move_joint(0, 1.0)
            time.sleep(0.05)
        wait_for(lambda: robot.joint_angles()[0] - angles[0] > 4)
        robot.reset(0)
        assert robot.joint_angles()[0] == pytest.approx(angles[0], abs=0.6)
        assert robot.measured("episode") == 1


@pytest.mark.slow
@pytest.mark.usefixtures("opengl")
@pytest.mark.parametrize("fault", ["silent", "gone", "second"])
def test_faults_of_the_process_stop_the_loop(agent, fault, tmp_path, capsys) -> None:
    log = tmp_path / "log.jsonl"
    with StandInProcess(agent.env, find_level("test"), sample_starts(agent.env, 1, 1)) as process:
        options = ["--port", str(process.port), "--level", "test", "--log", str(log)]
        if fault == "second":
            with StandInRobot(process.port):
                assert main(["deploy", "agent-a", *options, "--seconds", "2"]) == 2
            assert "another client drives this arm" in capsys.readouterr().err
            return
        number = signal.SIGSTOP if fault == "silent" else signal.SIGKILL

        def strike() -> None:
            wait_for(lambda: log.is_file() and log.read_text().count("\n") > 5)
            os.kill(process.process.pid, number)

        threading.Thread(target=strike).start()
        assert main(["deploy", "agent-a", *options, "--seconds", "120"]) == 2
    sentence = "the camera is silent" if fault == "silent" else "the stand-in is gone"
    error = capsys.readouterr().err
    assert sentence in error
    assert error.count("\n") == 1
    recording = read_log(log)
    assert sentence in recording.end
    assert main(["deploy", "agent-a", "--replay", str(log), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["ticks"] == found["same"] == len(recording.ticks) > 0
    assert found["largest"] < 1e-4


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--robot", "hal"], "--robot must be one of standin, dynamixel, got 'hal'"),
        (["--robot", "dynamixel"], "needs --arm FILE"),
        (["--robot", "dynamixel", "--arm", "no.json"], "no.json cannot be read"),
        (["--rate", "30"], "--rate must be one of 25, 50, got '30'"),
        (["--workspace", "0", "0", "0", "1", "1", "0"], "the workspace must be x y z"),
        (["--watchdog", "0"], "watchdog must be a finite number above 0"),
        (["--replay", "no.jsonl"], "the log no.jsonl cannot be read"),
        (["--port", "1"], "no stand-in listens on port 1"),
    ],
)
def test_bad_options_are_rejected_in_one_sentence(
    options, sentence, capsys, tmp_path, monkeypatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["deploy", "agent-a", *options]) == 2
    error = capsys.readouterr().err
    assert sentence in error
    assert error.count("\n") == 1
    assert list(tmp_path.iterdir()) == []
