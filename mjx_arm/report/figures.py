"""Curves of a run: the three of the paper's Figure 3, and what shows whether it learns."""

from __future__ import annotations

import pathlib

import numpy as np
from matplotlib.figure import Figure

from mjx_arm.report.metrics import read_metrics

_COLOUR = "#1f5fa8"


def plot_curves(folder: pathlib.Path) -> list[pathlib.Path]:
    """Draws the curves of a run folder as PNG files into it.

    `figure3.png` has the paper's three: cumulative successes, mean reward of a step and mean
    maximum Q of a step, over episodes. `learning.png` has success rate, share of steps with the
    cube grasped, distance between gripper and cube and loss, over environment steps.

    Returns:
      Paths of the files.

    Raises:
      ValueError: the folder holds no metrics.
    """
    rows = read_metrics(folder)
    column = {name: np.asarray([row[name] for row in rows]) for name in rows[0]}
    episodes = np.cumsum(column["episodes"])
    steps = column["env_steps"]
    paper = [
        ("cumulative successes", episodes, np.cumsum(column["successes"])),
        ("mean reward", episodes, column["mean_reward"]),
        ("mean max Q", episodes, column["mean_max_q"]),
    ]
    learning = [
        ("success rate", steps, column["success_rate"]),
        ("steps with the cube grasped", steps, column["grasp_share"]),
        ("distance gripper to cube (m)", steps, column["mean_distance"]),
        ("loss", steps, column["loss"]),
    ]
    return [
        _draw(folder / "figure3.png", paper, "episode"),
        _draw(folder / "learning.png", learning, "environment step"),
    ]


def _draw(
    path: pathlib.Path, panels: list[tuple[str, np.ndarray, np.ndarray]], x_label: str
) -> pathlib.Path:
    figure = Figure(figsize=(4.2 * len(panels), 3.2), layout="constrained")
    for axes, (title, x, y) in zip(figure.subplots(1, len(panels)), panels, strict=True):
        known = np.isfinite(y)
        marker = "." if known.sum() < 30 else ""
        axes.plot(x[known], y[known], color=_COLOUR, linewidth=1.4, marker=marker)
        axes.set_title(title, fontsize=10)
        axes.set_xlabel(x_label)
        axes.grid(alpha=0.3)
    figure.savefig(path, dpi=110)
    return path
