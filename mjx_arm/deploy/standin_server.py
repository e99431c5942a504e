"""The stand-in as a robot: a process of its own that runs in real time behind a loopback socket.

Its servos hold between commands. After every image it sends the image and the joint angles; images
that the client is too slow for are lost. One client at a time: a second one is told so and sent
away. When the client goes, or sends anything that is no command, the arm stops.
"""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import multiprocessing
import os
import pickle
import signal
import socket
import struct
import threading
import time
from collections.abc import Sequence
from multiprocessing.connection import Connection
from types import TracebackType
from typing import Any

import numpy as np

from mjx_arm.deploy.wire import LOOPBACK, ClosedError, GarbageError, receive, send
from mjx_arm.envs.env import Env
from mjx_arm.standin.episodes import Start, end_with
from mjx_arm.standin.levels import Offsets
from mjx_arm.standin.opengl import opengl_for_children
from mjx_arm.standin.world import StandIn

# A process that lags by more iterations than this skips time instead of catching up.
_MOST_BEHIND = 10
# A client that takes nothing for this long is gone, s.
_PATIENCE = 2.0
# A process that is not ready after this long has failed, s.
_STARTS_WITHIN = 120.0


class Server:
    """Listens, and hands the commands of one client at a time to whoever runs the arm.

    Args:
      hello: what a client is told first.
      port: on the loopback interface; 0 for any that is free.

    Attributes:
      port: on which it listens.

    Raises:
      ValueError: the port is taken.
    """

    def __init__(self, hello: dict[str, Any], port: int = 0) -> None:
        self._hello = hello
        self._listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            # Loopback alone: whoever reaches the socket moves the arm.
            self._listener.bind((LOOPBACK, port))
            self._listener.listen(4)
        except (OSError, OverflowError) as error:
            self._listener.close()
            raise ValueError(f"port {port} of {LOOPBACK} cannot be listened on: {error}") from error
        self.port: int = self._listener.getsockname()[1]
        self._lock = threading.Condition()
        self._client: _Client | None = None
        self._commands: collections.deque[dict[str, Any]] = collections.deque()
        threading.Thread(target=self._accept, daemon=True).start()

    def take_commands(self) -> list[dict[str, Any]]:
        """The commands since the last call; `{"kind": "stop"}` where the client has ended."""
        with self._lock:
            taken = list(self._commands)
            self._commands.clear()
        return taken

    def publish(self, state: dict[str, Any], image: np.ndarray) -> None:
        """Sends a state as soon as the client can take one, and forgets older ones."""
        message = {**state, "kind": "state", "shape": list(image.shape)}, image.tobytes()
        with self._lock:
            if self._client is not None:
                self._client.newest = message
                self._lock.notify_all()

    def close(self) -> None:
        """Stops listening, and ends the connection."""
        # On Linux close alone does not wake the thread in `accept`, and the port stays open.
        with contextlib.suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        with self._lock:
            if self._client is not None:
                self._client.goodbye = ""
                self._lock.notify_all()

    def _accept(self) -> None:
        while True:
            try:
                sock, _ = self._listener.accept()
            except OSError:
                return
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, _timeval(_PATIENCE))
            client = _Client(sock)
            with self._lock:
                if self._client is None:
                    self._client = client
                    threading.Thread(target=self._receive, args=(client,), daemon=True).start()
                else:
                    client.goodbye = "another client drives this arm"
            threading.Thread(target=self._send, args=(client,), daemon=True).start()

    def _send(self, client: _Client) -> None:
        """Sends the newest state again and again, until the client is to go; the only sender."""
        try:
            if client.goodbye is None:
                send(client.socket, {**self._hello, "kind": "hello"})
            while True:
                with self._lock:
                    self._lock.wait_for(lambda: client.newest or client.goodbye is not None)
                    message, client.newest = client.newest, None
                    goodbye = client.goodbye
                if goodbye is not None:
                    if goodbye:
                        send(client.socket, {"kind": "error", "sentence": goodbye})
                    break
                assert message is not None
                send(client.socket, *message)
        except ClosedError:
            pass
        # Also wakes the thread that receives.
        with contextlib.suppress(OSError):
            client.socket.shutdown(socket.SHUT_RDWR)
        client.socket.close()

    def _receive(self, client: _Client) -> None:
        wrong = ""
        try:
            while not wrong:
                command, _ = receive(client.socket)
                wrong = invalid_command(command, self._hello)
                if not wrong:
                    with self._lock:
                        self._commands.append(command)
        except GarbageError as error:
            wrong = str(error)
        except ClosedError:
            pass
        finally:
            with self._lock:
                self._commands.append({"kind": "stop"})
                self._client = None
                if client.goodbye is None:
                    client.goodbye = f"{wrong}: the arm has stopped" if wrong else ""
                self._lock.notify_all()


@dataclasses.dataclass(eq=False)
class _Client:
    """A connection.

    Attributes:
      socket: of it.
      newest: the state to send next.
      goodbye: why it is to be ended, or None; the client is told unless it is empty.
    """

    socket: socket.socket
    newest: tuple[dict[str, Any], bytes] | None = None
    goodbye: str | None = None


def _timeval(seconds: float) -> bytes:
    return struct.pack("ll", int(seconds), int(1e6 * (seconds % 1)))


def invalid_command(command: dict[str, Any], hello: dict[str, Any]) -> str:
    """What is wrong with a command, as a sentence; empty if nothing is."""
    kind = command["kind"]
    if kind in ("open", "close", "stop"):
        return ""
    if kind == "move":
        joint, degrees, step = command.get("joint"), command.get("degrees"), hello["step"]
        if type(joint) is not int or not 0 <= joint < len(hello["joints"]):
            return f"a command names the joint {joint!r}"
        if type(degrees) not in (int, float) or degrees not in (-step, step):
            return f"a command moves a joint by {degrees!r} degrees instead of {step:g}"
        return ""
    if kind == "reset":
        number = command.get("start")
        known = type(number) is int and 0 <= number < hello["starts"]
        return "" if known else f"a command names the start {number!r}"
    return f"a command is of the kind {kind!r}"


def run_server(world: StandIn, starts: Sequence[Start], server: Server) -> None:
    """Runs the stand-in in real time, for ever."""
    period = world.env.scene.substeps * world.model.opt.timestep
    world.reset(starts[0].qpos, starts[0].ctrl)
    began, done, number, episode = time.monotonic(), 0, 0, 0
    while True:
        for command in server.take_commands():
            episode += command["kind"] == "reset"
            _carry_out(world, starts, command)
        due = int((time.monotonic() - began) / period) - done
        if due > _MOST_BEHIND:
            done, due = done + due - 1, 1
        for _ in range(due):
            world.advance()
        if due:
            done, number = done + due, number + 1
            image, measured = world.look(), world.measure()
            state = {
                "number": number,
                "episode": episode,
                "joints": world.joints.tolist(),
                "success": measured.success,
                "grasped": measured.grasped,
            }
            server.publish(state, image)
        left = began + (done + 1) * period - time.monotonic()
        if left > 0:
            time.sleep(left)


def _carry_out(world: StandIn, starts: Sequence[Start], command: dict[str, Any]) -> None:
    arm, kind = world.env.arm, command["kind"]
    if kind == "move":
        world.command(2 * command["joint"] + (command["degrees"] > 0))
    elif kind == "open":
        world.command(arm.open_action)
    elif kind == "close":
        world.command(arm.close_action)
    elif kind == "reset":
        start = starts[command["start"]]
        world.reset(start.qpos, start.ctrl)
    else:
        world.hold()


def make_hello(env: Env, starts: Sequence[Start]) -> dict[str, Any]:
    """What a client is told first: names of the joints, step in degrees, number of starts."""
    model = env.scene.mj_model
    return {
        "joints": [model.actuator(int(i)).name for i in env.arm.ctrl],
        "step": env.config.degrees_per_action,
        "starts": len(starts),
    }


def _serve(job: bytes, parent: int, ready: Connection) -> None:
    """The process: reports its port or what is wrong, and then runs."""
    # Ctrl-C goes to all processes of a terminal; the client stops the arm.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=end_with, args=(parent,), daemon=True).start()
    try:
        env, offsets, starts, port = pickle.loads(job)
        world = StandIn(env, offsets)
        # Compiles; the server then resets the world.
        world.reset(starts[0].qpos, starts[0].ctrl)
        world.command(0)
        world.measure()
        server = Server(make_hello(env, starts), port)
    except ValueError as error:
        ready.send(str(error))
        return
    ready.send(server.port)
    run_server(world, starts, server)


class StandInProcess:
    """The stand-in in a process of its own; use it in a `with` block.

    Args:
      env: the simulator's environment.
      offsets: of the level.
      starts: of its episodes; it begins with the first one.
      port: on the loopback interface; 0 for any that is free.

    Attributes:
      port: on which it listens.
      process: the process.

    Raises:
      ValueError: there is no OpenGL, or the port is taken, or the process has ended.
    """

    def __init__(
        self, env: Env, offsets: Offsets, starts: Sequence[Start], *, port: int = 0
    ) -> None:
        context = multiprocessing.get_context("spawn")
        ready, other = context.Pipe(duplex=False)
        job = pickle.dumps((env, offsets, list(starts), port))
        self.process = context.Process(target=_serve, args=(job, os.getpid(), other), daemon=True)
        with opengl_for_children():
            self.process.start()
        other.close()
        with ready:
            try:
                said = ready.recv() if ready.poll(_STARTS_WITHIN) else "it does not start"
            except EOFError:
                said = "its process has ended"
        if not isinstance(said, int):
            self.close()
            raise ValueError(f"the stand-in cannot run: {said}")
        self.port = said

    def close(self) -> None:
        """Ends the process."""
        self.process.kill()
        self.process.join()

    def __enter__(self) -> StandInProcess:
        """Returns the stand-in."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Ends the process."""
        self.close()
