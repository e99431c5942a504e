"""Keeps MuJoCo from printing its warnings."""

from __future__ import annotations

import threading

import mujoco


class _Silence:
    """Keeps MuJoCo from printing warnings and writing MUJOCO_LOG.TXT; safe to nest and to share."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._depth = 0
        self._saved: mujoco.MjLogConfig | None = None

    def __enter__(self) -> None:
        with self._lock:
            if self._depth == 0:
                self._saved = mujoco.MjLogConfig.get()
                quiet = mujoco.MjLogConfig.get()
                quiet.logto_file = False
                quiet.logto_console = False
                mujoco.MjLogConfig.set(quiet)
            self._depth += 1

    def __exit__(self, *exc_info: object) -> None:
        with self._lock:
            self._depth -= 1
            if self._depth == 0:
                mujoco.MjLogConfig.set(self._saved)


mujoco_silence = _Silence()
