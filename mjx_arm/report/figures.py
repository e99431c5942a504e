"""Curves of a run: the three of the paper's Figure 3, and those that show whether it learns."""

from __future__ import annotations

import dataclasses
import io
import itertools
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from mjx_arm.report.metrics import read_metrics

# Distinct in greyscale and for colour-blind readers (Okabe & Ito 2008).
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00")
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
      of_steps: it is counted in steps, and not in episodes that have ended.
    """

    title: str
    unit: str
    column: str
    dots: tuple[str, str] | None = None
    of_steps: bool = False


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


def plot_curves(
    folders: Sequence[pathlib.Path], into: pathlib.Path, *, units: Mapping[str, str]
) -> list[pathlib.Path]:
    """Draws the curves of run folders as PNG files.

    `figure3.png` has the paper's three: cumulative successes, mean reward of a step and mean
    maximum Q of a step, over episodes. `learning.png` has the success rate (of training, and of the
    held-out episodes that select the best agent), the loss and the task's own metrics over
    environment steps. Thin lines are the chunks, thick lines their smoothed mean; several runs get
    their mean with the range between the least and the largest.

    Args:
      folders: with metrics.
      into: where the files go.
      units: of the task's metrics; see `mjx_arm.register`.

    Returns:
      Paths of the files.

    Raises:
      ValueError: a folder holds no metrics.
    """
    runs, names = _read_runs(folders)
    return [
        _draw(into / "figure3.png", _PAPER, "episode", runs, names),
        _draw(into / "learning.png", _learning_panels(runs[0], units), "env_steps", runs, names),
    ]


def draw_panels(
    folders: Sequence[pathlib.Path], *, units: Mapping[str, str]
) -> list[tuple[str, bytes]]:
    """Draws each curve of `plot_curves` as an SVG picture of its own.

    Args:
      folders: with metrics.
      units: of the task's metrics; see `mjx_arm.register`.

    Returns:
      The title and the content of each picture: those of `learning.png`, then of `figure3.png`.

    Raises:
      ValueError: a folder holds no metrics.
    """
    runs, names = _read_runs(folders)
    panels = [(panel, "env_steps") for panel in _learning_panels(runs[0], units)]
    panels += [(panel, "episode") for panel in _PAPER]
    return [(panel.title, _draw_svg(panel, x_name, runs, names)) for panel, x_name in panels]


def draw_groups(
    groups: Mapping[str, Sequence[pathlib.Path]], *, units: Mapping[str, str]
) -> list[tuple[str, bytes]]:
    """Draws the curves of several runs in one picture each, as `draw_panels` does.

    Args:
      groups: names of the runs, and the folders of their seeds, with metrics.
      units: of the metrics of their tasks; see `mjx_arm.register`.

    Returns:
      The title and the content of each picture.

    Raises:
      ValueError: a folder holds no metrics.
    """
    runs = {name: [_columns(folder) for folder in folders] for name, folders in groups.items()}
    # Runs of different tasks have different metrics; each picture shows the runs that have it.
    panels: dict[_Panel, str] = {}
    for seeds in runs.values():
        panels |= dict.fromkeys(_learning_panels(seeds[0], units), "env_steps")
    panels |= dict.fromkeys(_PAPER, "episode")
    pictures = []
    for panel, x_name in panels.items():
        figure = Figure(figsize=(4.4, 3.3), layout="constrained")
        axes = figure.subplots()
        for (name, seeds), colour in zip(runs.items(), itertools.cycle(COLOURS), strict=False):
            _draw_group(axes, panel, x_name, seeds, name, colour)
        if not any(np.size(line.get_xdata()) for line in axes.get_lines()):
            axes.text(0.5, 0.5, _why_empty(panel), transform=axes.transAxes, ha="center")
        _finish(axes, panel, x_name, legend=True)
        pictures.append((panel.title, to_svg(figure, panel.title)))
    return pictures


def _draw_group(
    axes: Axes,
    panel: _Panel,
    x_name: str,
    seeds: Sequence[dict[str, np.ndarray]],
    name: str,
    colour: str,
) -> None:
    """The curves of one run in one colour."""
    curves = [_known(seed, x_name, panel.column) for seed in seeds]
    for x, y in curves:
        line = y if len(seeds) == 1 else smooth(y)
        axes.plot(x, line, color=colour, lw=0.8, alpha=0.35)
    if len(seeds) == 1:
        axes.plot(curves[0][0], smooth(curves[0][1]), color=colour, lw=1.6, label=name)
    elif (spread := _spread(curves)) is not None:
        grid, values = spread
        axes.fill_between(grid, values.min(0), values.max(0), color=colour, alpha=0.15, lw=0)
        axes.plot(grid, values.mean(0), color=colour, lw=1.6, label=name)
    if panel.dots is not None:
        for seed in seeds:
            x, y = _known(seed, x_name, panel.dots[0])
            axes.plot(x, y, color=colour, ls="", marker="D", ms=3.5, mec="black")


def _read_runs(
    folders: Sequence[pathlib.Path],
) -> tuple[list[dict[str, np.ndarray]], list[str]]:
    return [_columns(folder) for folder in folders], [folder.name for folder in folders]


def _learning_panels(columns: Mapping[str, np.ndarray], units: Mapping[str, str]) -> list[_Panel]:
    # A user's own algorithm need not have a loss.
    known = [panel for panel in _LEARNING if panel.column in columns]
    return known + _task_panels(columns, units)


def _task_panels(columns: Mapping[str, np.ndarray], units: Mapping[str, str]) -> list[_Panel]:
    """Panels for the metrics of a task: shares of steps, and means."""
    known = {"mean_reward", "mean_max_q", "mean_length", "blocked_share"}
    panels = []
    for column in columns:
        if column in known:
            continue
        if column.endswith("_share"):
            name, title, unit = column.removesuffix("_share"), "", "share of steps"
        elif column.startswith("mean_"):
            name, title = column.removeprefix("mean_"), "mean "
            unit = units.get(name, "mean of a step")
        else:
            continue
        panels.append(_Panel(title + name.replace("_", " "), unit, column, of_steps=True))
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


def _draw_svg(
    panel: _Panel, x_name: str, runs: list[dict[str, np.ndarray]], names: list[str]
) -> bytes:
    figure = Figure(figsize=(4.4, 3.3), layout="constrained")
    _draw_panel(figure.subplots(), panel, x_name, runs, names)
    return to_svg(figure, panel.title)


def to_svg(figure: Figure, salt: str) -> bytes:
    """A figure as SVG: the same bytes for the same curves and the same `salt`."""
    content = io.BytesIO()
    # Without a salt the names inside of the file are random.
    with matplotlib.rc_context({"svg.hashsalt": salt}):
        figure.savefig(content, format="svg", metadata={"Date": None, "Creator": None})
    return content.getvalue()


def _draw_panel(
    axes: Axes,
    panel: _Panel,
    x_name: str,
    runs: list[dict[str, np.ndarray]],
    names: list[str],
) -> None:
    empty = True
    for run, name, colour in zip(runs, names, itertools.cycle(COLOURS), strict=False):
        x, y = _known(run, x_name, panel.column)
        empty &= x.size == 0
        few = x.size < 30
        raw, smoothed = ("raw", "smoothed") if len(runs) == 1 else (None, name)
        thin: dict[str, Any] = {"lw": 0.8, "alpha": 0.35, "marker": "." if few else ""}
        axes.plot(x, y, color=colour, label=raw, **thin)
        axes.plot(x, smooth(y), color=colour, lw=1.6, label=smoothed)
        if panel.dots is not None:
            x, y = _known(run, x_name, panel.dots[0])
            label = panel.dots[1] if run is runs[0] and x.size else None
            axes.plot(x, y, color=colour, ls="", marker="D", ms=3.5, mec="black", label=label)
            empty &= x.size == 0
    if len(runs) > 1:
        _draw_spread(axes, panel.column, x_name, runs)
    if empty:
        axes.text(0.5, 0.5, _why_empty(panel), transform=axes.transAxes, ha="center", va="center")
    _finish(axes, panel, x_name, legend=not empty)


def _finish(axes: Axes, panel: _Panel, x_name: str, *, legend: bool) -> None:
    """Names, units, limits and the legend of a panel."""
    if panel.unit.startswith("share"):
        axes.set_ylim(-0.03, 1.03)
    axes.set_title(panel.title, fontsize=10)
    axes.set_xlabel(_X_LABELS[x_name])
    axes.set_ylabel(panel.unit)
    axes.xaxis.set_major_locator(MaxNLocator(4))
    axes.grid(alpha=0.3)
    if legend and axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize=7, loc=_emptier_corner(axes))


def _emptier_corner(axes: Axes) -> Literal["upper right", "lower right"]:
    """The right corner that the curves leave free.

    Not matplotlib's own search, which warns about the time it takes on a busy machine.
    """
    (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
    ends = [points[-1] for points in map(_points, axes.get_lines()) if points.size]
    heights = [y for x, y in ends if x > left + 0.6 * (right - left)]
    falls = bool(heights) and float(np.mean(heights)) < (low + high) / 2
    return "upper right" if falls else "lower right"


def _points(line: Line2D) -> np.ndarray:
    return np.asarray(line.get_xydata(), float)


def _draw_spread(axes: Axes, column: str, x_name: str, runs: list[dict[str, np.ndarray]]) -> None:
    """Range and mean of several runs."""
    spread = _spread([_known(run, x_name, column) for run in runs])
    if spread is None:
        return
    grid, values = spread
    axes.fill_between(grid, values.min(0), values.max(0), color="0.5", alpha=0.2, lw=0)
    axes.plot(grid, values.mean(0), color="black", lw=1.2, ls="--", label="mean")


def _spread(
    curves: Sequence[tuple[np.ndarray, np.ndarray]],
) -> tuple[np.ndarray, np.ndarray] | None:
    """Smoothed curves on a grid that all of them cover: `[200]` and `[n, 200]`."""
    if any(x.size < 2 for x, _ in curves):
        return None
    grid = np.linspace(max(x[0] for x, _ in curves), min(x[-1] for x, _ in curves), 200)
    return grid, np.stack([np.interp(grid, x, smooth(y)) for x, y in curves])


def _known(run: dict[str, np.ndarray], x_name: str, column: str) -> tuple[np.ndarray, np.ndarray]:
    if column not in run:
        return np.zeros(0), np.zeros(0)
    known = np.isfinite(run[column])
    return run[x_name][known], run[column][known]


def smooth(values: np.ndarray) -> np.ndarray:
    """A centred moving mean over a twentieth of the values, shorter at the ends."""
    half = max(1, int(_WINDOW * len(values)) // 2)
    sums = np.concatenate([[0.0], np.cumsum(values)])
    index = np.arange(len(values))
    low, high = np.maximum(index - half, 0), np.minimum(index + half + 1, len(values))
    return np.asarray((sums[high] - sums[low]) / np.maximum(high - low, 1))


def _why_empty(panel: _Panel) -> str:
    if panel.column == "loss":
        return "no update yet"
    if panel.of_steps:
        return "no step yet"
    return "no episode has ended yet"
