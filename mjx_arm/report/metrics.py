"""Metrics of a run on disk: one JSON object per line, and TensorBoard events."""

from __future__ import annotations

import json
import math
import pathlib
import time
from types import TracebackType
from typing import Self

from tensorboardX.event_file_writer import EventsWriter
from tensorboardX.proto.event_pb2 import Event
from tensorboardX.summary import scalar


class MetricsWriter:
    """Appends the metrics of each chunk to `metrics.jsonl` and to TensorBoard events."""

    def __init__(self, folder: pathlib.Path):
        self._file = (folder / "metrics.jsonl").open("a", buffering=1)
        (folder / "tensorboard").mkdir(exist_ok=True)
        # Not tensorboardX's SummaryWriter: on a full disk its thread dies, and the next write waits
        # for it for ever.
        self._events = EventsWriter(str(folder / "tensorboard" / "events"))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._file.close()
        self._events.close()

    def write(self, metrics: dict[str, float]) -> None:
        """Writes one chunk's metrics; `env_steps` is their place on the axis. NaN becomes null."""
        finite = {k: (v if math.isfinite(v) else None) for k, v in metrics.items()}
        self._file.write(json.dumps(finite) + "\n")
        for name, value in finite.items():
            if value is not None:
                event = Event(
                    wall_time=time.time(),
                    step=int(metrics["env_steps"]),
                    summary=scalar(name, value),
                )
                self._events.write_event(event)
        self._events.flush()


def keep_metrics(folder: pathlib.Path, env_steps: int) -> None:
    """Drops the lines of `metrics.jsonl` after a number of environment steps.

    Raises:
      ValueError: a line is damaged.
    """
    path = folder / "metrics.jsonl"
    lines = _whole_lines(path) if path.is_file() else []
    rows = _read_rows(path) if path.is_file() else []
    kept = [line for line, row in zip(lines, rows, strict=True) if row["env_steps"] <= env_steps]
    shorter = path.with_suffix(".part")
    shorter.write_bytes(b"".join(kept))
    shorter.replace(path)


def last_wall_s(folder: pathlib.Path) -> float:
    """Seconds that the run in this folder has trained for, 0 where there is none."""
    return _last(folder, "wall_s")


def last_env_steps(folder: pathlib.Path) -> int:
    """Environment steps that the metrics in this folder reach to, 0 where there are none."""
    return int(_last(folder, "env_steps"))


def _last(folder: pathlib.Path, name: str) -> float:
    path = folder / "metrics.jsonl"
    rows = _read_rows(path) if path.is_file() else []
    return rows[-1][name] if rows else 0.0


def read_metrics(folder: pathlib.Path) -> list[dict[str, float]]:
    """Reads `metrics.jsonl` of a run folder; null becomes NaN.

    Raises:
      ValueError: the folder holds no metrics.
    """
    path = folder / "metrics.jsonl"
    if not path.is_file():
        raise ValueError(f"{folder} is no run folder: it has no metrics.jsonl")
    rows = _read_rows(path)
    if not rows:
        raise ValueError(f"{path} holds no metrics yet: wait for the first chunk of the run")
    return rows


def _read_rows(path: pathlib.Path) -> list[dict[str, float]]:
    return [_parse_row(path, i + 1, line) for i, line in enumerate(_whole_lines(path))]


def _whole_lines(path: pathlib.Path) -> list[bytes]:
    # A process that was killed may have left half a line.
    return [line for line in path.read_bytes().splitlines(keepends=True) if line.endswith(b"\n")]


def _parse_row(path: pathlib.Path, number: int, line: bytes) -> dict[str, float]:
    try:
        row = json.loads(line)
        known = isinstance(row, dict) and all(name in row for name in ("env_steps", "wall_s"))
        if known and all(x is None or type(x) in (int, float) for x in row.values()):
            return {name: math.nan if x is None else x for name, x in row.items()}
    except (ValueError, RecursionError):
        pass
    raise ValueError(f"{path}, line {number} is damaged: restore it, or remove the line")
