from __future__ import annotations

import io

import pytest
from rich.console import Console

from mjx_arm.report.progress import RunProgress


def row(**changes: float) -> dict[str, float]:
    values = {"success_rate": 0.5, "episodes": 10.0, "steps_per_s": 100.0, "q_mean": 1.0}
    return values | {"epsilon": 0.1} | changes


def printed(rows: list[dict[str, float]], monkeypatch, seconds: float) -> list[str]:
    now = [0.0]
    monkeypatch.setattr("mjx_arm.report.progress.time.monotonic", lambda: now[0])
    file = io.StringIO()
    with RunProgress(Console(file=file, width=200), total=100 * len(rows)) as progress:
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
