"""The place where several processes meet: jax's coordination service, in a process of its own.

jax starts the service inside of process 0. If that process is lost, jax ends all the others at once
with a page of its own. In a process of its own the service stays for a minute, in which the others
find out and end with one sentence. The service is jax's own and is started as jax starts it.

As a program, which imports neither this package nor jax:

    python meeting.py HOST:PORT NUMBER HEARTBEAT SHUTDOWN
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from typing import Any
from unittest import mock

# The service stays for so long when process 0 is lost, seconds: the others need 35 to find out.
_STAY = 60
_READY, _END = "ready", "end"


class Meeting:
    """The service in a process of its own, for process 0.

    Attributes:
      process: that process.
    """

    def __init__(
        self, address: str, number: int, *, heartbeat_timeout: int, shutdown_timeout: int, **_: Any
    ) -> None:
        """Starts the process, and waits until the service listens.

        Args:
          address: `HOST:PORT` to listen on.
          number: processes that meet.
          heartbeat_timeout: a process that is silent for so long is lost, seconds.
          shutdown_timeout: so long the processes wait for one another at the end, seconds.
          _: what else jax passes, which is left at its default.

        Raises:
          RuntimeError: the service did not start.
        """
        options = (address, number, heartbeat_timeout, shutdown_timeout)
        # The service of a run whose process 0 was lost keeps the port for so long.
        deadline, waits = time.monotonic() + _STAY + 5, False
        while (said := self._start(*options)) != _READY:
            if time.monotonic() > deadline:
                raise RuntimeError(f"the coordination service did not start on {address}: {said}")
            if not waits:
                waits = True
                sys.stderr.write(f"waiting for {address}, at most {_STAY + 5} s: {said}\n")
            time.sleep(1)

    def _start(self, *options: Any) -> str:
        """Starts the process; what it says."""
        self.process = subprocess.Popen(
            [sys.executable, __file__, *map(str, options)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            # A signal to the group of process 0 is not for the service.
            start_new_session=True,
        )
        assert self.process.stdout is not None
        said = self.process.stdout.readline().strip()
        if said == _READY:
            return said
        self.process.kill()
        self.process.communicate()
        # Where the port is in use, jaxlib sometimes crashes before it can say so.
        return said or "the port may be in use"

    def shutdown(self) -> None:
        """Ends the service, once the processes have left it."""
        with contextlib.suppress(OSError, subprocess.TimeoutExpired):
            self.process.communicate(f"{_END}\n", timeout=_STAY)
            return
        self.process.kill()
        self.process.communicate()


@contextlib.contextmanager
def apart() -> Iterator[None]:
    """Within it, `jax.distributed.initialize` starts the service in a process of its own.

    The function of jax that is replaced is not a public one. Where it is missing, the service
    starts in process 0, as jax does it.
    """
    from jax._src.lib import _jax

    name = "get_distributed_runtime_service"
    if not hasattr(_jax, name):
        yield
        return
    with mock.patch.object(_jax, name, Meeting):
        yield


def _serve(address: str, number: str, heartbeat: str, shutdown: str) -> None:
    """Runs the service until process 0 says that it is over, or for a while after it is lost."""
    for each in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1, signal.SIGUSR2):
        signal.signal(each, signal.SIG_IGN)
    from jaxlib import _jax

    try:
        service = _jax.get_distributed_runtime_service(
            address,
            int(number),
            heartbeat_timeout=int(heartbeat),
            shutdown_timeout=int(shutdown),
        )
    except Exception as error:
        _say(" ".join(str(error).split()))
        return
    _say(_READY)
    if sys.stdin.readline().strip() == _END:
        service.shutdown()
        return
    time.sleep(_STAY)
    os._exit(0)


def _say(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    _serve(*sys.argv[1:])
