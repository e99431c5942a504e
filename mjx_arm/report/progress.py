"""Lines and the progress bar that a training run shows."""

from __future__ import annotations

import codecs
import contextlib
import math
import pathlib
import shutil
import sys
import threading
import time
from collections.abc import Iterator
from types import TracebackType
from typing import Any, Self

import jax
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn

_SECONDS_BETWEEN_LINES = 30.0
_TRAINING = "training"
# Episodes that the shown success rate averages over, and chunks that the speed does.
_EPISODES = 200.0
_CHUNKS = 10.0


class _Lossy:
    """A text file that writes `?` for what its encoding has no character for."""

    def __init__(self, file: Any):
        self._file = file

    def write(self, text: str) -> int:
        encoding = self._file.encoding
        written: int = self._file.write(text.encode(encoding, "replace").decode(encoding))
        return written

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)


def make_console() -> Console:
    """A console on the standard output, which no character that it lacks can end."""
    encoding = getattr(sys.stdout, "encoding", None) or "utf-8"
    if codecs.lookup(encoding).name == "utf-8":
        return Console(highlight=False)
    file: Any = _Lossy(sys.stdout)
    return Console(file=file, highlight=False)


def say_device(console: Console) -> None:
    """Says which device runs it, and how to use an NVIDIA card that jax does not see."""
    device = jax.devices()[0]
    console.print(f"device: {device.device_kind} ({device.platform}), jax {jax.__version__}")
    if device.platform == "cpu" and _has_nvidia_card():
        console.print(
            "[yellow]warning: there is an NVIDIA card, but this jax runs on the CPU only; "
            "`make setup GPU=cuda13` installs the one that uses it[/yellow]"
        )


def say_mesh(console: Console, devices: int, *, by_seed: bool) -> None:
    """Says what several devices do."""
    of_processes = f" of {jax.process_count()} processes" if jax.process_count() > 1 else ""
    what = "some of the seeds" if by_seed else "a part of the environments, the replay and batches"
    console.print(f"devices: {devices}{of_processes}, each with {what}; memory is that of one")


def say_memory(console: Console, plan: dict[str, int]) -> None:
    """Says what the run will hold in memory."""
    parts = ", ".join(f"{name} {size / 1e6:.1f} MB" for name, size in plan.items())
    console.print(f"memory: {parts}; {sum(plan.values()) / 1e6:.1f} MB")


def say_working_memory(console: Console, plan: dict[str, int]) -> None:
    """Says what the run will need beside that, once the compiler knows."""
    working, total = plan["working"] / 1e6, sum(plan.values()) / 1e6
    console.print(f"memory: {working:.1f} MB more to work in; {total:.1f} MB in all")


class Heartbeat:
    """Says that a run is alive: a line after each 30 seconds without one, from a thread.

    The line names the phase and its time. In a terminal and on a quiet console nothing is printed.
    Nothing is printed after the end of the `with` block.

    Args:
      console: where it prints.
      phase: what is being done, such as `compiling`.
      seconds: between two lines.
    """

    def __init__(self, console: Console, phase: str, seconds: float = _SECONDS_BETWEEN_LINES):
        self._console, self._phase, self._seconds = console, phase, seconds
        self._began = self._last = time.monotonic()
        self._lock = threading.Lock()
        self._ended = threading.Event()
        # A daemon, so that an end of the process without the end of the block does not wait for it.
        self._thread = threading.Thread(target=self._beat, name="heartbeat", daemon=True)

    def __enter__(self) -> Self:
        if not self._console.is_terminal and not self._console.quiet:
            self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._ended.set()
        if self._thread.is_alive():
            self._thread.join()

    def begin(self, phase: str) -> None:
        """Another phase begins now."""
        with self._lock:
            self._phase, self._began = phase, time.monotonic()

    def say(self, line: str) -> None:
        """Prints a line, and waits again before the next one."""
        with self._lock:
            self._last = time.monotonic()
            self._console.print(line, soft_wrap=True)

    def _beat(self) -> None:
        # The main thread meets the errors of its own output; this one ends without a word.
        with contextlib.suppress(OSError):
            while not self._ended.wait(max(self._last + self._seconds - time.monotonic(), 0.0)):
                with self._lock:
                    now = time.monotonic()
                    if now - self._last < self._seconds or self._ended.is_set():
                        continue
                    self._last = now
                    text = f"{self._phase}, {_minutes(now - self._began)} so far"
                    self._console.print(text, soft_wrap=True)


@contextlib.contextmanager
def phase(
    console: Console, name: str, note: str = "", *, seconds: float = _SECONDS_BETWEEN_LINES
) -> Iterator[None]:
    """Prints what is being done, and again while it lasts; see `Heartbeat`.

    Args:
      console: where it prints.
      name: what is being done.
      note: more about it, for the first line.
      seconds: between two lines.
    """
    console.print(f"{name}: {note}" if note else name, soft_wrap=True)
    with Heartbeat(console, name, seconds):
        yield


class RunProgress:
    """The progress of a training run: a bar in a terminal, plain lines anywhere else.

    Without a terminal (a pipe, a scheduler's log) it prints a line at least every 30 seconds: about
    a chunk that has ended, or where a chunk takes longer, the phase and its time.

    Args:
      console: where it prints.
      total: environment steps of the whole run.
      done: environment steps that were made before.
      slower_from: environment steps from which on a step takes longer, as in `distill` where the
        student starts. Until then the time left is not known.
      seconds: between two lines.
    """

    def __init__(
        self,
        console: Console,
        total: int,
        done: int = 0,
        *,
        slower_from: int = 0,
        seconds: float = _SECONDS_BETWEEN_LINES,
    ):
        self._console, self._total, self._done = console, total, done
        self._slower_from = slower_from if slower_from < total else 0
        self._seconds = seconds
        self._success = _Smoothed(_EPISODES)
        self._speed = _Smoothed(_CHUNKS)
        self._last_line = -math.inf
        self._last_update = time.monotonic()
        self._heartbeat = Heartbeat(console, _TRAINING, seconds)
        self._bar = Progress(
            TextColumn("{task.completed:,.0f} of {task.total:,.0f} ({task.percentage:.0f} %)"),
            BarColumn(bar_width=10),
            TextColumn("{task.fields[metrics]}"),
            console=console,
            disable=not console.is_terminal,
        )
        self._task = self._bar.add_task("", total=total, completed=done, metrics="")

    def __enter__(self) -> Self:
        self._bar.start()
        self._heartbeat.__enter__()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._heartbeat.__exit__(kind, error, trace)
        self._bar.stop()

    def update(self, completed: int, rows: list[dict[str, float]]) -> None:
        """Shows a chunk.

        Args:
          completed: environment steps so far.
          rows: the metrics of each seed.
        """
        metrics = {name: sum(row[name] for row in rows) / len(rows) for name in rows[0]}
        self._success.add(metrics["success_rate"], metrics["episodes"])
        if self._done >= self._slower_from:  # all of the chunk is slow
            self._speed.add(1.0 / metrics["steps_per_s"], 1.0)
        self._done = completed
        left = (self._total - completed) * self._speed.mean
        text = self._describe(metrics, left)
        self._bar.update(self._task, completed=completed, metrics=text)
        self._heartbeat.begin(_TRAINING)
        now = time.monotonic()
        # The next chunk may end too late.
        next_update = now + (now - self._last_update)
        self._last_update = now
        due = next_update - self._last_line > self._seconds or completed >= self._total
        if not self._console.is_terminal and due:
            self._last_line = now
            share = 100 * completed / self._total
            self._heartbeat.say(f"{completed:,} of {self._total:,} steps ({share:.0f} %), {text}")

    def phase(self, name: str) -> None:
        """Says what is being done between two chunks."""
        self._bar.update(self._task, metrics=name)
        self._heartbeat.begin(name)
        if not self._console.is_terminal:
            self._heartbeat.say(name)

    def _describe(self, metrics: dict[str, float], seconds_left: float) -> str:
        parts = [f"{metrics['steps_per_s']:,.0f} steps/s"]
        if not math.isnan(self._success.mean):
            parts.append(f"success {100 * self._success.mean:.0f} %")
        if "q_mean" in metrics:  # not every algorithm has it
            parts.append(f"max Q {metrics['q_mean']:.1f}")
        parts.append(f"ε {metrics['epsilon']:.2f}")
        if math.isnan(seconds_left):
            parts.append(f"time left unknown before {self._slower_from:,} steps")
        else:
            parts.append(f"{_minutes(seconds_left)} left")
        return ", ".join(parts)


class _Smoothed:
    """A weighted mean of the newest values, over a weight of about `window`."""

    def __init__(self, window: float) -> None:
        self._window, self._sum, self._weight = window, 0.0, 0.0

    def add(self, value: float, weight: float) -> None:
        if math.isnan(value) or weight <= 0.0:
            return
        keep = math.exp(-weight / self._window)
        self._sum = keep * self._sum + weight * value
        self._weight = keep * self._weight + weight

    @property
    def mean(self) -> float:
        return self._sum / self._weight if self._weight else math.nan


def _minutes(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return (
        f"{minutes // 60} h {minutes % 60:02d} min"
        if minutes >= 60
        else f"{minutes}:{rest:02d} min"
    )


def _has_nvidia_card() -> bool:
    return pathlib.Path("/proc/driver/nvidia/version").exists() or bool(shutil.which("nvidia-smi"))
