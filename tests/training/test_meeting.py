"""jax's coordination service in a process of its own."""

from __future__ import annotations

import os
import pathlib
import signal
import socket
import subprocess
import sys
import threading

import pytest

from mjx_arm.training import meeting

ROOT = pathlib.Path(__file__).parents[2]


def free_port() -> int:
    with socket.socket() as free:
        free.bind(("localhost", 0))
        return free.getsockname()[1]


def listens(port: int) -> bool:
    try:
        socket.create_connection(("localhost", port), timeout=5).close()
    except OSError:
        return False
    return True


def test_the_service_ends_when_the_meeting_is_over():
    port = free_port()
    service = meeting.Meeting(f"localhost:{port}", 2, heartbeat_timeout=100, shutdown_timeout=5)
    assert listens(port)
    service.shutdown()
    assert service.process.returncode == 0
    assert not listens(port)


def test_a_port_in_use_is_an_error(monkeypatch):
    monkeypatch.setattr(meeting, "_STAY", -5)
    with socket.socket() as other:
        other.bind(("localhost", 0))
        other.listen()
        address = f"localhost:{other.getsockname()[1]}"
        with pytest.raises(RuntimeError, match=rf"did not start on {address}: [A-Zt]"):
            meeting.Meeting(address, 2, heartbeat_timeout=100, shutdown_timeout=5)


def test_the_service_waits_for_a_port_that_becomes_free(capsys):
    with socket.socket() as other:
        other.bind(("localhost", 0))
        other.listen()
        port = other.getsockname()[1]
        threading.Timer(2, other.close).start()
        service = meeting.Meeting(f"localhost:{port}", 2, heartbeat_timeout=100, shutdown_timeout=5)
    assert listens(port)
    service.shutdown()
    assert f"waiting for localhost:{port}, at most 65 s" in capsys.readouterr().err


def test_the_service_outlives_a_lost_process_and_its_signals():
    port = free_port()
    program = f"""
import os
from mjx_arm.training.meeting import Meeting
service = Meeting("localhost:{port}", 2, heartbeat_timeout=100, shutdown_timeout=5)
print(service.process.pid, flush=True)
os.kill(os.getpid(), 9)
"""
    lost = subprocess.run(
        [sys.executable, "-c", program],
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert lost.returncode == -signal.SIGKILL
    pid = int(lost.stdout)
    try:
        os.kill(pid, signal.SIGTERM)
        os.kill(pid, signal.SIGINT)
        assert listens(port)
    finally:
        os.kill(pid, signal.SIGKILL)
