"""Plots of the page as SVG: each line has its own colour, dash and marker."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import MaxNLocator

from mjx_arm.report.figures import COLOURS, smooth, to_svg
from mjx_arm.reproduce.james_johns import REGULAR_EPISODE
from mjx_arm.training.evaluate import wilson_interval

_DASHES = ("-", "--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)))
_HATCHES = ("", "///", "...", "xx")
_SIZE = 9

Curve = Mapping[str, Any]


def _axes(width: float, height: float, rows: int = 1, columns: int = 1) -> tuple[Figure, Any]:
    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False)


def _style() -> Iterator[tuple[str, Any]]:
    """Colours that differ in greyscale, each with a dash of its own."""
    return zip(itertools.cycle(COLOURS), itertools.cycle(_DASHES))


def _label(axes: Axes, title: str, x: str, y: str) -> None:
    axes.set_title(title, fontsize=_SIZE + 1)
    axes.set_xlabel(x, fontsize=_SIZE)
    axes.set_ylabel(y, fontsize=_SIZE)
    axes.tick_params(labelsize=_SIZE - 1)
    axes.grid(alpha=0.3)


_ROWS = (
    ("cumulative_successes", "cumulative successes", "episodes"),
    ("mean_reward", "mean reward of a step", "reward"),
    ("mean_max_q", "mean maximum Q of a step", "Q-value"),
)
# Column, label, and unit of a horizontal axis.
_X = (("episode", "episodes", 1.0), ("env_steps", "environment steps, millions", 1e6))


def draw_figure3(groups: Mapping[str, Sequence[Curve]]) -> bytes:
    """Figure 3 of the paper, over episodes (left) and over environment steps (right).

    Args:
      groups: name of a way of training -> the curves of its seeds. Several seeds get their mean and
        a band from the least to the largest.
    """
    figure, axes = _axes(9.6, 8.4, len(_ROWS), len(_X))
    for row, (column, title, unit) in enumerate(_ROWS):
        for place, (x, x_label, unit_of_x) in enumerate(_X):
            own = axes[row, place]
            for (name, seeds), (colour, dash) in zip(groups.items(), _style(), strict=False):
                known = [_known(seed, x, column) for seed in seeds]
                scaled = [(at / unit_of_x, values) for at, values in known]
                _draw_seeds(own, scaled, name, colour, dash)
                if row == 0:
                    _mark_regular(own, seeds, x, unit_of_x, colour, dash)
            if row == 0 and x == "episode":
                own.axvline(REGULAR_EPISODE, color="black", lw=1, ls=":")
                own.text(REGULAR_EPISODE, 0.98, " paper: 1,800", transform=_mixed(own), va="top",
                         fontsize=_SIZE - 1)  # fmt: skip
            _label(own, title, x_label, unit)
            own.xaxis.set_major_locator(MaxNLocator(5))
    handles, labels = axes[0, 0].get_legend_handles_labels()
    if handles:
        figure.legend(handles, labels, fontsize=_SIZE, loc="outside upper center")
    return to_svg(figure, "figure3")


def _mixed(axes: Axes) -> Any:
    return axes.get_xaxis_transform()


def _known(curve: Curve, x: str, column: str) -> tuple[np.ndarray, np.ndarray]:
    values = np.asarray([np.nan if v is None else v for v in curve[column]], float)
    known = np.isfinite(values)
    return np.asarray(curve[x], float)[known], values[known]


def _draw_seeds(
    axes: Axes, curves: Sequence[tuple[np.ndarray, np.ndarray]], name: str, colour: str, dash: Any
) -> None:
    curves = [(x, y) for x, y in curves if x.size]
    if not curves:
        return
    if len(curves) == 1:
        x, y = curves[0]
        axes.plot(x, y, color=colour, lw=0.8, alpha=0.35)
        axes.plot(x, smooth(y), color=colour, ls=dash, lw=1.8, label=name)
        return
    grid = np.linspace(max(x[0] for x, _ in curves), min(x[-1] for x, _ in curves), 200)
    values = np.stack([np.interp(grid, x, smooth(y)) for x, y in curves])
    axes.fill_between(grid, values.min(0), values.max(0), color=colour, alpha=0.2, lw=0)
    axes.plot(grid, values.mean(0), color=colour, ls=dash, lw=1.8, label=name)


def _mark_regular(
    axes: Axes, seeds: Sequence[Curve], x: str, unit: float, colour: str, dash: Any
) -> None:
    for seed in seeds:
        if seed["regular"] is not None:
            at = seed["regular"][x] / unit
            axes.axvline(at, color=colour, lw=1.2, ls=dash, alpha=0.8)
            axes.text(at, 0.86, " regular", transform=_mixed(axes), fontsize=_SIZE - 1)


def draw_figure4(episode: Mapping[str, Any]) -> bytes:
    """Q-values along an episode, with the five marked frames, and the cube's height below."""
    figure, axes = _axes(8.4, 4.6, 2, 1)
    top, bottom = axes[:, 0]
    q = np.asarray(episode["q"]) / episode["reward_scale"]
    top.plot(q, color=COLOURS[0], lw=1.6)
    numbers: dict[int, list[str]] = {}
    for i, mark in enumerate(episode["marks"]):
        numbers.setdefault(min(mark["frame"], len(q) - 1), []).append(str(i + 1))
    for frame, marked in numbers.items():
        top.plot(frame, q[frame], "o", color="black", ms=5)
        top.annotate(", ".join(marked), (frame, q[frame]), (0, 7), textcoords="offset points",
                     ha="center", fontsize=_SIZE + 1, weight="bold")  # fmt: skip
    top.margins(y=0.2)
    _label(top, "largest Q-value before each step", "", "Q-value")
    steps = np.arange(1, len(episode["height"]) + 1)
    bottom.plot(steps, 100 * np.asarray(episode["distance"]), color=COLOURS[1], ls="--",
                label="distance from gripper to cube")  # fmt: skip
    bottom.plot(steps, 100 * np.asarray(episode["height"]), color=COLOURS[2],
                label="height of the cube")  # fmt: skip
    bottom.legend(fontsize=_SIZE - 1)
    _label(bottom, "", "step", "cm")
    return to_svg(figure, "figure4")


def draw_network(layers: Sequence[Mapping[str, Any]]) -> bytes:
    """The network as a row of boxes, as high as the layer's picture and as wide as its channels."""
    figure = Figure(figsize=(11.0, 3.4))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set_axis_off()
    pitch = 2.0
    for number, layer in enumerate(layers):
        shape, middle = layer["output"], number * pitch
        height = np.sqrt(shape[0]) if len(shape) == 3 else np.log2(shape[0])
        width = 0.3 + (np.log2(shape[-1]) / 8 if len(shape) == 3 else 0.0)
        shade = str(0.95 - 0.07 * min(6, number))
        corner = (middle - width / 2, -height / 2)
        axes.add_patch(Rectangle(corner, width, height, fc=shade, ec="black", lw=1))
        size = "×".join(map(str, shape))
        axes.text(middle, -height / 2 - 0.3, size, ha="center", va="top", fontsize=9)
        name = str(layer["name"]).replace(", ", "\n").replace(" of ", "\nof ")
        name = name.replace(" and ", "\nand ").replace("fully ", "fully\n")
        axes.text(middle, 4.5, name, ha="center", va="bottom", fontsize=8.5)
        if number:
            arrow = {"arrowstyle": "->"}
            axes.annotate("", (middle - 0.6, 0), (middle - pitch + 0.6, 0), arrowprops=arrow)
    axes.set_xlim(-pitch / 2, (len(layers) - 0.5) * pitch)
    axes.set_ylim(-5.4, 7.9)
    return to_svg(figure, "network")


def draw_places(columns: Mapping[str, Any], rectangle: Sequence[float] | None) -> bytes:
    """Success by the cube's place, seen from above: crosses are failures."""
    figure, axes = _axes(4.6, 5.0)
    own = axes[0, 0]
    cubes = 100 * np.asarray(columns["cube"], float)
    success = np.asarray(columns["success"], bool)
    own.plot(cubes[success, 1], cubes[success, 0], "o", ms=4, mfc="none", mec=COLOURS[0],
             mew=0.7, alpha=0.55, label=f"success ({success.sum()})")  # fmt: skip
    own.plot(cubes[~success, 1], cubes[~success, 0], "X", ms=8, color=COLOURS[1], mec="black",
             mew=0.6, label=f"failure ({(~success).sum()})")  # fmt: skip
    if rectangle is not None:
        x, y, half_x, half_y = (100 * value for value in rectangle)
        own.add_patch(Rectangle((y - half_y, x - half_x), 2 * half_y, 2 * half_x, fill=False,
                                ec="black", lw=1))  # fmt: skip
    own.set_aspect("equal", adjustable="datalim")
    own.invert_xaxis()
    own.legend(fontsize=_SIZE - 1, loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=2)
    _label(own, "place of the cube at the start", "to the left of the base, cm",
           "in front of the base, cm")  # fmt: skip
    return to_svg(figure, "places")


_BINS = 5


def draw_joints(columns: Mapping[str, Any], noise: float) -> bytes:
    """Success by where each joint started, in five bins with 95 % intervals.

    Args:
      columns: of the episodes.
      noise: the joints start within this of home, degrees.
    """
    joints = np.asarray(columns["joints"], float)
    success = np.asarray(columns["success"], bool)
    count = joints.shape[1]
    figure, axes = _axes(8.4, 4.8, 2, -(-count // 2))
    edges = np.linspace(-noise, noise, _BINS + 1)
    middles = (edges[1:] + edges[:-1]) / 2
    least = 100.0
    for i, own in enumerate(axes.ravel()):
        if i >= count:
            own.set_axis_off()
            continue
        bins = np.clip(np.digitize(joints[:, i], edges) - 1, 0, _BINS - 1)
        for b, middle in enumerate(middles):
            here = success[bins == b]
            if here.size:
                low, high = wilson_interval(int(here.sum()), here.size)
                least = min(least, 100 * low)
                own.plot([middle, middle], [100 * low, 100 * high], color="0.35", lw=1.5)
                own.plot(middle, 100 * here.mean(), "s", color=COLOURS[0], ms=5)
        own.axhline(100 * success.mean(), color="black", lw=0.8, ls=":")
        left = i % axes.shape[1] == 0
        _label(own, f"joint {i + 1}", "degrees from home", "success, %" if left else "")
    for own in axes.ravel():
        own.set_ylim(max(0.0, least - 3), 103)
    return to_svg(figure, "joints")


def draw_heights(histograms: Mapping[str, Sequence[Mapping[str, Any]]], lift: float) -> bytes:
    """Where the cube is while it is grasped, a histogram for each reward, seeds together."""
    figure, axes = _axes(8.4, 2.9, 1, len(histograms))
    for own, (name, found), colour, hatch in zip(
        axes[0], histograms.items(), COLOURS, _HATCHES, strict=False
    ):
        steps = np.sum([each["steps"] for each in found], axis=0)
        edges = 100 * np.asarray(found[0]["edges"])
        share = 100 * steps / max(1, steps.sum())
        own.bar(edges[:-1], share, np.diff(edges), align="edge", color=colour, hatch=hatch,
                ec="black", lw=0.4)  # fmt: skip
        own.axvline(100 * lift, color="black", lw=1, ls=":")
        _label(own, name, "height of the cube, cm", "share of grasped steps, %")
    return to_svg(figure, "heights")


def draw_study(groups: Mapping[str, Sequence[Curve]], *, goal: float | None = None) -> bytes:
    """Success and the largest Q-value of trainings over environment steps.

    Args:
      groups: names and the curves of their seeds.
      goal: a Q-value to mark: the terminal reward.
    """
    figure, axes = _axes(9.6, 3.6, 1, 2)
    left, right = axes[0]
    for (name, seeds), (colour, dash) in zip(groups.items(), _style(), strict=False):
        for own, column, factor in ((left, "success_rate", 100), (right, "mean_max_q", 1)):
            curves = [_known(seed, "env_steps", column) for seed in seeds]
            scaled = [(x / 1e6, factor * y) for x, y in curves]
            _draw_seeds(own, scaled, name, colour, dash)
    left.set_ylim(-3, 103)
    if goal is not None:
        right.axhline(goal, color="black", lw=1, ls=":")
        right.text(0.01, goal, "reward of success", transform=right.get_yaxis_transform(),
                   fontsize=_SIZE - 1, va="bottom")  # fmt: skip
    _label(left, "success of training episodes", "environment steps, millions", "%")
    _label(right, "mean maximum Q of a step", "environment steps, millions", "Q-value")
    if any(line.get_label()[:1] != "_" for line in left.get_lines()):
        left.legend(fontsize=_SIZE - 1)
    return to_svg(figure, "study")


def draw_effects(rows: Sequence[tuple[str, float, float, float]]) -> bytes:
    """Differences with their intervals, in percentage points; the largest loss on top.

    Args:
      rows: of each its name, the difference, and the ends of its interval, as shares.
    """
    ordered = sorted(rows, key=lambda row: -row[1])
    figure, axes = _axes(8.4, 0.8 + 0.36 * len(rows))
    own = axes[0, 0]
    for i, (_, middle, low, high) in enumerate(ordered):
        own.plot([100 * low, 100 * high], [i, i], color="0.35", lw=1.8)
        own.plot(100 * middle, i, "s", color=COLOURS[0], ms=6)
    own.axvline(0, color="black", lw=1, ls=":")
    own.set_yticks(range(len(ordered)), [row[0] for row in ordered])
    _label(own, "", "success minus the default's, percentage points", "")
    return to_svg(figure, "effects")
