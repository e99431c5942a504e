"""Metrics of a run on disk: one JSON object per line, and TensorBoard events."""

from __future__ import annotations

import contextlib
import json
import math
import pathlib
import time
from types import TracebackType
from typing import Any, NoReturn, Self

from tensorboardX.event_file_writer import EventsWriter
from tensorboardX.proto.event_pb2 import Event
from tensorboardX.summary import scalar

# Metrics that every row has as numbers; others may be null.
_ALWAYS = ("env_steps", "wall_s", "episodes", "successes")
_NUMBERS = (int, float)


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
      ValueError: the folder holds no metrics, or a line is damaged.
    """
    path = folder / "metrics.jsonl"
    if not path.is_file():
        raise ValueError(f"{folder} is no run folder: it has no metrics.jsonl")
    rows = _read_rows(path)
    if not rows:
        raise ValueError(f"{path} holds no metrics yet: wait for the first chunk of the run")
    return rows


def _read_rows(path: pathlib.Path) -> list[dict[str, float]]:
    rows = [_parse_row(path, i + 1, line) for i, line in enumerate(_whole_lines(path))]
    _check_names(path, rows)
    return rows


def _check_names(path: pathlib.Path, rows: list[dict[str, float]]) -> None:
    """Rejects a row that lacks a metric which an earlier row has.

    The first row must also have what all later ones have. Later rows may have more: another version
    has continued the run.
    """
    later = [name for name in rows[-1] if all(name in row for row in rows[1:])] if rows else []
    known: dict[str, None] = dict.fromkeys(later)
    for number, row in enumerate(rows, start=1):
        for name in known:
            if name not in row:
                raise _damaged(path, number, f": it lacks {name!r}, which other lines have")
        known = dict.fromkeys(row) if number == 1 else known | dict.fromkeys(row)


def _whole_lines(path: pathlib.Path) -> list[bytes]:
    # A process that was killed may have left half a line.
    return [line for line in path.read_bytes().splitlines(keepends=True) if line.endswith(b"\n")]


def _parse_row(path: pathlib.Path, number: int, line: bytes) -> dict[str, float]:
    with contextlib.suppress(ValueError, OverflowError, RecursionError):
        row = json.loads(line, parse_constant=_reject)
        if isinstance(row, dict) and _has_numbers(row):
            return {name: math.nan if x is None else x for name, x in row.items()}
    raise _damaged(path, number)


def _has_numbers(row: dict[str, Any]) -> bool:
    """Whether a row has finite numbers and null alone; OverflowError where no float holds one."""
    always = all(type(row.get(name)) in _NUMBERS for name in _ALWAYS)
    known = [x for x in row.values() if x is not None]
    return always and all(type(x) in _NUMBERS and not math.isinf(x) for x in known)


def _reject(constant: str) -> NoReturn:
    raise ValueError(constant)


def _damaged(path: pathlib.Path, number: int, why: str = "") -> ValueError:
    return ValueError(f"{path}, line {number} is damaged{why}: restore it, or remove the line")
