"""Metrics of a run on disk: one JSON object a line, and TensorBoard events."""

from __future__ import annotations

import json
import math
import pathlib
from types import TracebackType
from typing import Self

from tensorboardX import SummaryWriter


class MetricsWriter:
    """Appends the metrics of each chunk to `metrics.jsonl` and to TensorBoard events."""

    def __init__(self, folder: pathlib.Path):
        self._file = (folder / "metrics.jsonl").open("a", buffering=1)
        self._events = SummaryWriter(str(folder / "tensorboard"))

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
                self._events.add_scalar(name, value, int(metrics["env_steps"]))


def keep_metrics(folder: pathlib.Path, env_steps: int) -> None:
    """Drops the lines of `metrics.jsonl` after so many environment steps, which come again."""
    path = folder / "metrics.jsonl"
    lines = path.read_text().splitlines(keepends=True) if path.is_file() else []
    whole = [line for line in lines if line.endswith("\n")]
    kept = [line for line in whole if json.loads(line)["env_steps"] <= env_steps]
    shorter = path.with_suffix(".part")
    shorter.write_text("".join(kept))
    shorter.replace(path)


def last_wall_s(folder: pathlib.Path) -> float:
    """Seconds that the run in this folder has trained for, 0 where there is none."""
    path = folder / "metrics.jsonl"
    rows = read_metrics(folder) if path.is_file() else []
    return rows[-1]["wall_s"] if rows else 0.0


def read_metrics(folder: pathlib.Path) -> list[dict[str, float]]:
    """Reads `metrics.jsonl` of a run folder; null becomes NaN.

    Raises:
      ValueError: the folder holds no metrics.
    """
    path = folder / "metrics.jsonl"
    if not path.is_file():
        raise ValueError(f"{folder} is no run folder: it has no metrics.jsonl")
    rows = [json.loads(line) for line in path.read_text().splitlines()]
    return [{k: float("nan") if v is None else v for k, v in row.items()} for row in rows]
