from __future__ import annotations

import io
import threading

import pytest
from rich.console import Console

from mjx_arm.report.progress import Heartbeat, RunProgress, phase


def row(**changes: float) -> dict[str, float]:
    values = {"success_rate": 0.5, "episodes": 10.0, "steps_per_s": 100.0, "q_mean": 1.0}
    return values | {"epsilon": 0.1} | changes


def printed(
    rows: list[dict[str, float]], monkeypatch, seconds: float, slower_from: int = 0
) -> list[str]:
    now = [0.0]
    monkeypatch.setattr("mjx_arm.report.progress.time.monotonic", lambda: now[0])
    file = io.StringIO()
    console, total = Console(file=file, width=200), 100 * len(rows)
    with RunProgress(console, total, slower_from=slower_from) as progress:
        for i, values in enumerate(rows):
            now[0] += seconds
            progress.update(100 * (i + 1), [values])
    return file.getvalue().splitlines()


def test_without_a_terminal_lines_come_every_thirty_seconds_and_at_the_end(monkeypatch):
    lines = printed([row()] * 20, monkeypatch, seconds=10.0)
    assert len(lines) == 8
    assert lines[0].startswith("100 of 2,000 steps (5 %), 100 steps/s, success 50 %")
    assert lines[-1].startswith("2,000 of 2,000 steps (100 %)")


def test_the_time_left_follows_the_speed_of_the_last_chunks(monkeypatch):
    fast, slow = row(steps_per_s=1000.0), row(steps_per_s=10.0)
    lines = printed([fast] * 50 + [slow] * 50 + [fast], monkeypatch, seconds=30.0)
    # 100 steps are left, at 10 steps/s; the 50 fast chunks are forgotten.
    assert "0:10 min left" in lines[-2]


def test_the_time_left_is_not_known_before_steps_become_slower(monkeypatch):
    rows = [row(steps_per_s=1000.0)] * 3 + [row(steps_per_s=10.0)] * 2
    lines = printed(rows, monkeypatch, seconds=30.0, slower_from=250)
    # The third chunk is slow in part only, and the fourth is the first one that is slow as a whole.
    assert [line.rsplit(", ", 1)[1] for line in lines] == [
        *["time left unknown before 250 steps"] * 3,
        *("0:10 min left", "0:00 min left"),
    ]
    # A run that ends before has one speed.
    assert "0:00 min left" in printed(rows[:2], monkeypatch, 30.0, slower_from=250)[-1]


def test_a_chunk_without_an_episode_keeps_the_success_rate(monkeypatch):
    rows = [row(success_rate=0.25), row(success_rate=float("nan"), episodes=0.0)]
    assert "success 25 %" in printed(rows, monkeypatch, seconds=40.0)[-1]


def test_an_algorithm_need_not_have_q_values(monkeypatch):
    values = row()
    del values["q_mean"]
    assert "max Q" not in printed([values], monkeypatch, seconds=40.0)[0]


@pytest.mark.parametrize("seeds", [1, 3])
def test_the_metrics_of_several_seeds_are_averaged(monkeypatch, seeds):
    file = io.StringIO()
    with RunProgress(Console(file=file, width=200), total=100) as progress:
        progress.update(100, [row(success_rate=i / 10, episodes=1.0) for i in range(seeds)])
    expected = {1: "success 0 %", 3: "success 10 %"}[seeds]
    assert expected in file.getvalue()


class Output(io.StringIO):
    """What is printed, for a test that waits for it."""

    def __init__(self) -> None:
        super().__init__()
        self._changed = threading.Condition()

    def write(self, text: str) -> int:
        with self._changed:
            self._changed.notify_all()
            return super().write(text)

    def wait_for(self, text: str, times: int = 1) -> None:
        with self._changed:
            assert self._changed.wait_for(lambda: self.getvalue().count(text) >= times, timeout=60)


def beats() -> bool:
    """Whether the thread of a heartbeat runs."""
    return any(thread.name == "heartbeat" for thread in threading.enumerate())


@pytest.fixture
def output() -> Output:
    return Output()


def test_a_long_phase_is_named_with_its_time_until_it_ends(output):
    console = Console(file=output, width=200)
    with phase(console, "compiling", "about a minute", seconds=0.01):
        output.wait_for("compiling, 0:00 min so far\n", times=3)
    assert not beats()
    lines = output.getvalue().splitlines()
    assert lines[0] == "compiling: about a minute"
    assert set(lines[1:]) == {"compiling, 0:00 min so far"}


def test_the_time_of_a_phase_grows(output, monkeypatch):
    now = [0.0]
    monkeypatch.setattr("mjx_arm.report.progress.time.monotonic", lambda: now[0])
    with Heartbeat(Console(file=output, width=200), "compiling", seconds=1e-3):
        now[0] = 65.0
        output.wait_for("compiling, 1:05 min so far")


def test_a_heartbeat_ends_with_an_error_too(output):
    with (
        pytest.raises(RuntimeError, match="enough"),
        phase(Console(file=output), "compiling", seconds=0.01),
    ):
        raise RuntimeError("enough")
    assert not beats()


@pytest.mark.parametrize("options", [{"force_terminal": True}, {"quiet": True}])
def test_a_terminal_and_a_quiet_console_have_no_heartbeat(output, options):
    with phase(Console(file=output, **options), "compiling", seconds=0.0):
        assert not beats()


def test_lines_of_both_threads_stay_whole(output):
    # Without a pause between two lines.
    with Heartbeat(Console(file=output, width=200), "compiling", seconds=0.0) as heartbeat:
        for _ in range(100):
            heartbeat.say("x" * 60)
        output.wait_for("so far")
    lines = output.getvalue().splitlines()
    assert set(lines) == {"x" * 60, "compiling, 0:00 min so far"}
    assert lines.count("x" * 60) == 100


def test_an_output_that_fails_ends_a_heartbeat_without_a_word():
    failed = threading.Event()

    class Full(io.StringIO):
        def write(self, text: str) -> int:
            failed.set()
            raise OSError(28, "No space left on device")

    with Heartbeat(Console(file=Full()), "compiling", seconds=0.0):
        assert failed.wait(60)
    assert not beats()


def test_a_long_chunk_and_a_long_selection_are_named(output):
    with RunProgress(Console(file=output, width=200), total=200, seconds=0.01) as progress:
        output.wait_for("training, 0:00 min so far")
        progress.phase("selecting: 200 episodes")
        output.wait_for("selecting: 200 episodes, 0:00 min so far")
        progress.update(100, [row()])
        output.wait_for("100 of 200 steps (50 %), 100 steps/s")
        before = output.getvalue().count("training, ")
        output.wait_for("training, 0:00 min so far", times=before + 1)
        progress.update(200, [row()])
    assert not beats()
    assert "\nselecting: 200 episodes\n" in output.getvalue()


def test_a_chunk_whose_next_one_would_be_late_has_a_line(monkeypatch):
    lines = printed([row()] * 6, monkeypatch, seconds=20.0)
    assert len(lines) == 6
