"""Curves of a run: the three of the paper's Figure 3, and those that show whether it learns."""

from __future__ import annotations

import dataclasses
import itertools
import pathlib
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from mjx_arm.report.metrics import read_metrics

# Distinct in greyscale and for colour-blind readers (Okabe & Ito 2008).
_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00")
_X_LABELS = {"episode": "episodes", "env_steps": "environment steps"}
# Rows that the smoothed line averages over, as a share of all rows.
_WINDOW = 0.05


@dataclasses.dataclass(frozen=True)
class _Panel:
    """One pair of axes.

    Attributes:
      title: what it shows.
      unit: of the vertical axis.
      column: of the metrics.
      dots: a second column, drawn as dots, and its name in the legend.
    """

    title: str
    unit: str
    column: str
    dots: tuple[str, str] | None = None


_PAPER = (
    _Panel("cumulative successes", "episodes", "cumulative_successes"),
    _Panel("mean reward", "reward per step", "mean_reward"),
    _Panel("mean maximum Q", "Q-value", "mean_max_q"),
)
_LEARNING = (
    _Panel(
        "success rate", "share of episodes", "success_rate", ("selection_rate", "held-out episodes")
    ),
    _Panel("loss", "loss", "loss"),
)


def plot_curves(folders: Sequence[pathlib.Path], into: pathlib.Path) -> list[pathlib.Path]:
    """Draws the curves of run folders as PNG files.

    `figure3.png` has the paper's three: cumulative successes, mean reward of a step and mean
    maximum Q of a step, over episodes. `learning.png` has the success rate (of training, and of the
    held-out episodes that select the best agent), the loss and the task's own metrics over
    environment steps. Thin lines are the chunks, thick lines their smoothed mean; several runs get
    their mean with the range between the least and the largest.

    Args:
      folders: with metrics.
      into: where the files go.

    Returns:
      Paths of the files.

    Raises:
      ValueError: a folder holds no metrics.
    """
    runs = [_columns(folder) for folder in folders]
    names = [folder.name for folder in folders]
    # A user's own algorithm need not have a loss.
    learning = [panel for panel in _LEARNING if panel.column in runs[0]]
    learning += _task_panels(runs[0])
    return [
        _draw(into / "figure3.png", _PAPER, "episode", runs, names),
        _draw(into / "learning.png", learning, "env_steps", runs, names),
    ]


def _task_panels(columns: dict[str, np.ndarray]) -> list[_Panel]:
    """Panels for the metrics of a task: shares of steps, and means."""
    known = {"mean_reward", "mean_max_q", "mean_length", "blocked_share"}
    panels = []
    for name in columns:
        if name in known:
            continue
        if name.endswith("_share"):
            title = name.removesuffix("_share").replace("_", " ")
            panels.append(_Panel(title, "share of steps", name))
        elif name.startswith("mean_"):
            title = f"mean {name.removeprefix('mean_').replace('_', ' ')}"
            unit = "m" if any(word in name for word in ("distance", "height")) else "mean of a step"
            panels.append(_Panel(title, unit, name))
    return panels


def _columns(folder: pathlib.Path) -> dict[str, np.ndarray]:
    rows = read_metrics(folder)
    columns = {name: np.asarray([row[name] for row in rows], float) for name in rows[0]}
    columns["episode"] = np.cumsum(columns["episodes"])
    columns["cumulative_successes"] = np.cumsum(columns["successes"])
    return columns


def _draw(
    path: pathlib.Path,
    panels: Sequence[_Panel],
    x_name: str,
    runs: list[dict[str, np.ndarray]],
    names: list[str],
) -> pathlib.Path:
    columns = min(len(panels), 3)
    rows = -(-len(panels) // columns)
    figure = Figure(figsize=(4.4 * columns, 3.3 * rows), layout="constrained")
    axes = np.atleast_1d(figure.subplots(rows, columns)).ravel()
    for one, panel in itertools.zip_longest(axes, panels):
        if panel is None:
            one.set_axis_off()
            continue
        _draw_panel(one, panel, x_name, runs, names)
    figure.savefig(path, dpi=110)
    return path


def _draw_panel(
    axes: Axes,
    panel: _Panel,
    x_name: str,
    runs: list[dict[str, np.ndarray]],
    names: list[str],
) -> None:
    empty = True
    for run, name, colour in zip(runs, names, itertools.cycle(_COLOURS), strict=False):
        x, y = _known(run, x_name, panel.column)
        empty &= x.size == 0
        few = x.size < 30
        axes.plot(x, y, color=colour, lw=0.8, alpha=0.35, marker="." if few else "")
        axes.plot(x, _smooth(y), color=colour, lw=1.6, label=name if len(runs) > 1 else "training")
        if panel.dots is not None:
            x, y = _known(run, x_name, panel.dots[0])
            label = panel.dots[1] if run is runs[0] and x.size else None
            axes.plot(x, y, color=colour, ls="", marker="D", ms=3.5, mec="black", label=label)
            empty &= x.size == 0
    if len(runs) > 1:
        _draw_spread(axes, panel.column, x_name, runs)
    if empty:
        axes.text(0.5, 0.5, _why_empty(panel), transform=axes.transAxes, ha="center", va="center")
    if panel.unit.startswith("share"):
        axes.set_ylim(-0.03, 1.03)
    axes.set_title(panel.title, fontsize=10)
    axes.set_xlabel(_X_LABELS[x_name])
    axes.set_ylabel(panel.unit)
    axes.xaxis.set_major_locator(MaxNLocator(4))
    axes.grid(alpha=0.3)
    if (len(runs) > 1 or panel.dots is not None) and not empty:
        axes.legend(fontsize=7)


def _draw_spread(axes: Axes, column: str, x_name: str, runs: list[dict[str, np.ndarray]]) -> None:
    """Range and mean of several runs, on a grid that all of them cover."""
    known = [_known(run, x_name, column) for run in runs]
    if any(x.size < 2 for x, _ in known):
        return
    grid = np.linspace(max(x[0] for x, _ in known), min(x[-1] for x, _ in known), 200)
    values = np.stack([np.interp(grid, x, _smooth(y)) for x, y in known])
    axes.fill_between(grid, values.min(0), values.max(0), color="0.5", alpha=0.2, lw=0)
    axes.plot(grid, values.mean(0), color="black", lw=1.2, ls="--", label="mean")


def _known(run: dict[str, np.ndarray], x_name: str, column: str) -> tuple[np.ndarray, np.ndarray]:
    if column not in run:
        return np.zeros(0), np.zeros(0)
    known = np.isfinite(run[column])
    return run[x_name][known], run[column][known]


def _smooth(values: np.ndarray) -> np.ndarray:
    """A centred moving mean over a twentieth of the values, shorter at the ends."""
    half = max(1, int(_WINDOW * len(values)) // 2)
    sums = np.concatenate([[0.0], np.cumsum(values)])
    index = np.arange(len(values))
    low, high = np.maximum(index - half, 0), np.minimum(index + half + 1, len(values))
    return np.asarray((sums[high] - sums[low]) / np.maximum(high - low, 1))


def _why_empty(panel: _Panel) -> str:
    if panel.column == "loss":
        return "no update yet"
    if panel.unit in ("share of steps", "m", "mean of a step"):
        return "no step yet"
    return "no episode has ended yet"
