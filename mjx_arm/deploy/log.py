"""The log of a deployment: one JSON object per line, with every image, so that it can be replayed.

The first line says what ran. Each further line is one tick. The last line has `end`: why the run
ended.
"""

from __future__ import annotations

import base64
import dataclasses
import json
import pathlib
import zlib
from collections.abc import Callable, Mapping
from types import TracebackType
from typing import Any, TextIO

import numpy as np

FORMAT = "mjx_arm deploy 1"


class Log:
    """Writes a log; use it in a `with` block.

    Args:
      path: of the file, which must not be there yet; None writes nothing.
      header: what ran.

    Raises:
      ValueError: the file is there already, or cannot be written.
    """

    def __init__(self, path: pathlib.Path | None, header: Mapping[str, Any]) -> None:
        self.path, self._file = path, None if path is None else _open(path)
        self.write({"format": FORMAT, **header})

    def write(self, record: Mapping[str, Any]) -> None:
        """Adds a line, at once and whole; arrays become lists, and `image` is compressed."""
        if self._file is None:
            return
        values = {name: _plain(name, value) for name, value in record.items()}
        # One write, so that no signal comes between two parts of a line.
        self._file.write(json.dumps(values) + "\n")
        self._file.flush()

    def __enter__(self) -> Log:
        """Returns the log."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Closes the file."""
        if self._file is not None:
            self._file.close()


def _open(path: pathlib.Path) -> TextIO:
    try:
        return path.open("x", encoding="utf-8")
    except FileExistsError as error:
        raise ValueError(f"the log {path} is there already: give another one") from error
    except OSError as error:
        raise ValueError(f"the log {path} cannot be written: {error.strerror}") from error


def _plain(name: str, value: Any) -> Any:
    if name == "image":
        packed = zlib.compress(np.ascontiguousarray(value).tobytes(), 1)
        return {"shape": list(value.shape), "zlib": base64.b64encode(packed).decode()}
    return value.tolist() if isinstance(value, np.ndarray) else value


@dataclasses.dataclass(frozen=True)
class Recording:
    """A log that was read.

    Attributes:
      header: what ran.
      ticks: a record for each tick, with `image`, `[H, W, 3] uint8` or `[C, H, W, 3] uint8`, and
        `q`, `[A] float64`.
      end: why the run ended.
    """

    header: dict[str, Any]
    ticks: list[dict[str, Any]]
    end: str


def read_log(path: pathlib.Path) -> Recording:
    """Reads a log.

    Raises:
      ValueError: the file is missing or damaged, or its last line is not the end of a run.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not text in UTF-8"
        raise ValueError(f"the log {path} cannot be read: {reason}") from error
    records = [_read_line(path, number, line) for number, line in enumerate(lines, 1)]
    if not records or records[0].get("format") != FORMAT:
        raise ValueError(f"{path} is not a log of mjx-arm deploy")
    if "end" not in records[-1]:
        raise ValueError(f"the log {path} has no end: it is cut off after line {len(records)}")
    return Recording(records[0], [x for x in records[1:-1] if "tick" in x], records[-1]["end"])


def _read_line(path: pathlib.Path, number: int, line: str) -> dict[str, Any]:
    try:
        record = json.loads(line)
        if not isinstance(record, dict):
            raise ValueError("no object")
        if "tick" in record:
            packed, shape = record["image"]["zlib"], record["image"]["shape"]
            data = zlib.decompress(base64.b64decode(packed, validate=True))
            record["image"] = np.frombuffer(data, np.uint8).reshape(shape)
            record["q"] = np.asarray(record["q"], np.float64)
            record["best"] = int(record["best"])
    except (ValueError, KeyError, TypeError, RecursionError, zlib.error) as error:
        raise ValueError(f"the log {path} is damaged at line {number}") from error
    return record


@dataclasses.dataclass(frozen=True)
class Replay:
    """A policy's answers to the images of a log, compared with the logged ones.

    Attributes:
      ticks: number of ticks in the log.
      same: number of ticks in which the policy's best action is the logged one.
      largest: largest absolute difference of a Q-value.
      end: why the logged run ended.
    """

    ticks: int
    same: int
    largest: float
    end: str


def replay(path: pathlib.Path, policy: Callable[[np.ndarray], tuple[np.ndarray, int]]) -> Replay:
    """Gives the images of a log to a policy again, and compares Q-values and actions.

    Args:
      path: of the log.
      policy: `image uint8 -> (Q-values [A] float32, best action)`, as `mjx_arm.policy.Policy`.

    Raises:
      ValueError: the log is damaged, or its images do not fit the policy.
    """
    recording, same = read_log(path), 0
    differences = [0.0]
    for tick in recording.ticks:
        q, action = policy(tick["image"])
        if q.shape != tick["q"].shape:
            raise ValueError(
                f"the log {path} has {tick['q'].size} actions, and the policy {q.size}"
            )
        same += action == tick["best"]
        differences.append(np.abs(q - tick["q"]).max())
    # Not Python's max, which may lose NaN.
    return Replay(len(recording.ticks), same, float(np.max(differences)), recording.end)
