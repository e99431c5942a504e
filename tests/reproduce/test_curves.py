"""When success becomes regular, and the curve of a run."""

from __future__ import annotations

import pytest
from made_runs import make_run

from mjx_arm.reproduce.curves import read_curve, regular_from


def test_success_is_regular_from_the_start_of_the_first_hundred_episodes():
    episodes, steps = [50, 50, 50, 50], [100, 200, 300, 400]
    # Chunks 2 and 3 hold 100 episodes with 50 successes.
    assert regular_from(episodes, [0, 10, 40, 50], steps) == {"episode": 50, "env_steps": 100}


def test_it_may_be_regular_at_once_or_never():
    steps = [100, 200]
    assert regular_from([60, 60], [60, 0], steps) == {"episode": 0, "env_steps": 0}
    assert regular_from([60, 60], [30, 10], steps) is None
    assert regular_from([40, 40], [40, 40], steps) is None


def test_a_curve_is_divided_by_the_scale_of_the_reward(tmp_path):
    make_run(tmp_path / "run", env="B")
    curve = read_curve(tmp_path / "run", 0.2)
    assert curve["episode"] == [10, 20, 30, 40, 50, 60]
    assert curve["cumulative_successes"][-1] == 30
    assert curve["mean_max_q"] == pytest.approx([10.0] * 6)
    assert curve["selections"] == [[20_000, 0.4], [40_000, 0.6], [60_000, 0.95]]


def test_a_long_curve_is_thinned_and_keeps_its_end(tmp_path):
    make_run(tmp_path / "run", selections=(None,) * 700)
    curve = read_curve(tmp_path / "run", 1.0)
    assert len(curve["episode"]) == 300
    assert curve["env_steps"][-1] == 7_000_000
    assert curve["cumulative_successes"][-1] == 3_500
