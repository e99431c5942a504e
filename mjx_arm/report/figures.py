"""Curves of a run: the three of the paper's Figure 3, and what shows whether it learns."""

from __future__ import annotations

import itertools
import pathlib
from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from mjx_arm.report.metrics import read_metrics

_COLOURS = ("#1f5fa8", "#c4572b", "#3b8f4f", "#7d4fa0", "#8a6d1d", "#2a8f96")
_AXES = {"episode": "episode", "env_steps": "environment step"}
_PAPER = {
    "cumulative_successes": "cumulative successes",
    "mean_reward": "mean reward",
    "mean_max_q": "mean max Q",
}
_LEARNING = {"success_rate": "success rate", "loss": "loss"}


def plot_curves(folders: Sequence[pathlib.Path], into: pathlib.Path) -> list[pathlib.Path]:
    """Draws the curves of run folders, one line each, as PNG files.

    `figure3.png` has the paper's three: cumulative successes, mean reward of a step and mean
    maximum Q of a step, over episodes. `learning.png` has success rate, loss and the task's own
    metrics over environment steps.

    Args:
      folders: with metrics.
      into: where the files go.

    Returns:
      Paths of the files.

    Raises:
      ValueError: a folder holds no metrics.
    """
    runs = [_columns(folder) for folder in folders]
    # A user's own algorithm need not have a loss.
    learning = {name: title for name, title in _LEARNING.items() if name in runs[0]}
    return [
        _draw(into / "figure3.png", _PAPER, "episode", runs),
        _draw(into / "learning.png", learning | _task_panels(runs[0]), "env_steps", runs),
    ]


def _task_panels(columns: dict[str, np.ndarray]) -> dict[str, str]:
    """Panels for the metrics of a task: shares of steps, and means."""
    known = {*_PAPER, "mean_length", "blocked_share"}
    panels = {}
    for name in columns:
        if name.endswith("_share") and name not in known:
            panels[name] = f"{name.removesuffix('_share').replace('_', ' ')}, share of steps"
        elif name.startswith("mean_") and name not in known:
            panels[name] = f"mean {name.removeprefix('mean_').replace('_', ' ')}"
    return panels


def _columns(folder: pathlib.Path) -> dict[str, np.ndarray]:
    rows = read_metrics(folder)
    columns = {name: np.asarray([row[name] for row in rows]) for name in rows[0]}
    columns["episode"] = np.cumsum(columns["episodes"])
    columns["cumulative_successes"] = np.cumsum(columns["successes"])
    return columns


def _draw(
    path: pathlib.Path, panels: dict[str, str], x_name: str, runs: list[dict[str, np.ndarray]]
) -> pathlib.Path:
    figure = Figure(figsize=(4.2 * len(panels), 3.2), layout="constrained")
    for axes, (name, title) in zip(figure.subplots(1, len(panels)), panels.items(), strict=True):
        for run, colour in zip(runs, itertools.cycle(_COLOURS), strict=False):
            known = np.isfinite(run[name])
            marker = "." if known.sum() < 30 else ""
            axes.plot(run[x_name][known], run[name][known], color=colour, lw=1.4, marker=marker)
        axes.set_title(title, fontsize=10)
        axes.set_xlabel(_AXES[x_name])
        axes.xaxis.set_major_locator(MaxNLocator(4))
        axes.grid(alpha=0.3)
    figure.savefig(path, dpi=110)
    return path
