"""Curves of trainings: what Figure 3 shows, and when success becomes regular."""

from __future__ import annotations

import math
import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from mjx_arm.report.metrics import read_metrics

# Success is regular from the first 100 episodes in a row of which half end in success.
REGULAR_EPISODES, REGULAR_RATE = 100, 0.5
# Points of a curve in a file.
_MOST_POINTS = 300


def read_curve(run: pathlib.Path, reward_scale: float) -> dict[str, Any]:
    """The curve of one seed, from its `metrics.jsonl`.

    Args:
      run: the folder of the seed.
      reward_scale: factor on the rewards; the curve is divided by it, so that rewards and Q-values
        of different scales compare.

    Returns:
      Lists of at most 300 points: `episode`, `env_steps`, `cumulative_successes`, `success_rate`,
      `mean_reward`, `mean_max_q` (None where no episode ended); `selections`, pairs of steps and
      success rate; `regular`, see `regular_from`; `wall_s`.

    Raises:
      ValueError: the folder holds no metrics, or they are damaged.
    """
    rows = read_metrics(run)
    episodes = np.asarray([row["episodes"] for row in rows])
    successes = np.asarray([row["successes"] for row in rows])
    steps = np.asarray([row["env_steps"] for row in rows])
    kept = np.unique(np.linspace(0, len(rows) - 1, min(len(rows), _MOST_POINTS)).round())
    index = kept.astype(int)
    scaled = {
        name: [_finite(rows[i][name] / reward_scale) for i in index]
        for name in ("mean_reward", "mean_max_q")
    }
    selections = [
        [int(row["env_steps"]), row["selection_rate"]]
        for row in rows
        if not math.isnan(row.get("selection_rate", math.nan))
    ]
    return {
        "episode": np.cumsum(episodes)[index].astype(int).tolist(),
        "env_steps": steps[index].astype(int).tolist(),
        "cumulative_successes": np.cumsum(successes)[index].astype(int).tolist(),
        "success_rate": [_finite(rows[i]["success_rate"]) for i in index],
        **scaled,
        "selections": selections,
        "regular": regular_from(episodes, successes, steps),
        "wall_s": rows[-1]["wall_s"],
    }


def _finite(value: float) -> float | None:
    return round(value, 5) if math.isfinite(value) else None


def regular_from(
    episodes: Sequence[float] | np.ndarray,
    successes: Sequence[float] | np.ndarray,
    env_steps: Sequence[float] | np.ndarray,
) -> dict[str, int] | None:
    """Where success becomes regular: half of the last 100 or more episodes ended in success.

    Args:
      episodes: that ended in each chunk.
      successes: that ended in success in each chunk.
      env_steps: after each chunk.

    Returns:
      `episode` and `env_steps` at the start of the first such episodes; None where there are none.
    """
    ends, wins = np.cumsum(episodes), np.cumsum(successes)
    for last in range(len(ends)):
        first = int(np.searchsorted(ends, ends[last] - REGULAR_EPISODES, side="right")) - 1
        before = ends[first] if first >= 0 else 0.0
        if ends[last] - before < REGULAR_EPISODES:
            continue
        won = wins[last] - (wins[first] if first >= 0 else 0.0)
        if won / (ends[last] - before) >= REGULAR_RATE:
            steps = env_steps[first] if first >= 0 else 0
            return {"episode": int(before), "env_steps": int(steps)}
    return None
