"""Runs side by side: success with intervals, time to a success rate, and what was different."""

from __future__ import annotations

import dataclasses
import math
import pathlib
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from scipy.stats import t as student_t

from mjx_arm.config import TrainConfig
from mjx_arm.envs.tasks import find_task
from mjx_arm.options import flat_names, get_option
from mjx_arm.report import html
from mjx_arm.report.figures import draw_groups
from mjx_arm.report.metrics import read_metrics
from mjx_arm.report.run_page import duration, interval, percent, read_evaluation, show_option
from mjx_arm.tools.zoo import text_table
from mjx_arm.training.agent import evaluation_config
from mjx_arm.training.evaluate import newcombe_interval, wilson_interval
from mjx_arm.training.run_folder import load_config, seed_folders

# Success rates whose first selection is reported.
_LEVELS = (0.5, 0.9)
# Options that differ between any two runs, or say nothing about learning.
_UNINTERESTING = frozenset({"seed", "physics", "chunk_steps"})
_NONE = "–"


@dataclasses.dataclass(frozen=True)
class Share:
    """A success rate with its 95 % interval.

    Attributes:
      rate: the share.
      low: lower bound.
      high: upper bound.
      over: what the interval is over: `episodes` of one seed, or `seeds`.
    """

    rate: float
    low: float
    high: float
    over: str


@dataclasses.dataclass(frozen=True)
class RunResult:
    """What a run has come to.

    Attributes:
      name: of its folder.
      config: its options.
      folders: of its seeds.
      counts: successes and episodes of the evaluation of each seed; empty if one is missing.
      env_steps: environment steps of a seed.
      wall_s: seconds of training.
      reached: for each level of success, environment steps and seconds until a selection had
        reached it, the medians over the seeds; None if a seed never did.
    """

    name: str
    config: TrainConfig
    folders: tuple[pathlib.Path, ...]
    counts: tuple[tuple[int, int], ...]
    env_steps: int
    wall_s: float
    reached: tuple[tuple[float, float] | None, ...]

    @property
    def share(self) -> Share | None:
        """The success rate; None if a seed has not been evaluated."""
        return share_of(self.counts)


def share_of(counts: Sequence[tuple[int, int]]) -> Share | None:
    """The success rate of one or more seeds, with its 95 % interval.

    Args:
      counts: successes and episodes of each seed.

    Returns:
      One seed: Wilson's interval, over its episodes. Several: Student's, over the seeds; where
      all have the same rate it would have no width, and Wilson's over all episodes is taken. None
      where there is no seed.
    """
    if not counts:
        return None
    if _are_equal(counts):
        successes, episodes = _pooled(counts)
        return Share(successes / episodes, *wilson_interval(successes, episodes), over="episodes")
    mean, half = _mean_and_half_width([s / n for s, n in counts])
    return Share(mean, max(0.0, mean - half), min(1.0, mean + half), over="seeds")


def _are_equal(counts: Sequence[tuple[int, int]]) -> bool:
    """Whether all seeds have the same rate, as a single one has."""
    return len({successes / episodes for successes, episodes in counts}) == 1


def _pooled(counts: Sequence[tuple[int, int]]) -> tuple[int, int]:
    return sum(successes for successes, _ in counts), sum(episodes for _, episodes in counts)


def read_results(folders: Sequence[pathlib.Path]) -> list[RunResult]:
    """Reads runs, whose names are the ends of their paths in which they differ.

    Raises:
      ValueError: see `read_result`, or a folder is given twice.
    """
    paths = [folder.resolve() for folder in folders]
    for path in paths:
        if paths.count(path) > 1:
            raise ValueError(f"{path} is given twice")
    results = [read_result(folder) for folder in folders]
    return [
        dataclasses.replace(result, name=_short_name(path, paths))
        for result, path in zip(results, paths, strict=True)
    ]


def _short_name(path: pathlib.Path, paths: Sequence[pathlib.Path]) -> str:
    """The shortest end of a path that no other path has."""
    ends = (path.parts[-length:] for length in range(1, len(path.parts) + 1))
    own = (end for end in ends if [p.parts[-len(end) :] for p in paths].count(end) == 1)
    return "/".join(next(own))


def read_result(folder: pathlib.Path) -> RunResult:
    """Reads what a run has come to, from the files in its folder.

    Raises:
      ValueError: it is not a run folder, or a file in it is damaged.
    """
    config = load_config(folder)
    folders = tuple(seed_folders(folder, config))
    rows = [read_metrics(own) for own in folders]
    evaluations = [read_evaluation(own) for own in folders]
    counts = [(x["successes"], x["episodes"]) for x in evaluations if x is not None]
    return RunResult(
        name=folder.resolve().name,
        config=config,
        folders=folders,
        counts=tuple(counts) if len(counts) == len(folders) else (),
        env_steps=int(rows[0][-1]["env_steps"]),
        wall_s=rows[0][-1]["wall_s"],
        reached=tuple(_reached(rows, level) for level in _LEVELS),
    )


def _reached(seeds: Sequence[list[dict[str, float]]], level: float) -> tuple[float, float] | None:
    firsts = []
    for rows in seeds:
        found = [row for row in rows if row.get("selection_rate", math.nan) >= level]
        if not found:
            return None
        firsts.append((found[0]["env_steps"], found[0]["wall_s"]))
    steps, seconds = np.median(np.asarray(firsts), axis=0)
    return float(steps), float(seconds)


def difference(first: RunResult, other: RunResult) -> tuple[float, float, float] | None:
    """The success rate of `other` minus that of `first`, with its 95 % interval.

    Two runs of one seed, or of several that have the same rate: Newcombe's interval, over
    episodes. Two runs of several: Welch's, over seeds.

    Returns:
      Difference, lower and upper bound; None if a run was not evaluated, or only one has several
      seeds.
    """
    one, two = first.counts, other.counts
    if not one or not two or (len(one) == 1) != (len(two) == 1):
        return None
    if _are_equal(one) and _are_equal(two):
        one, two = (_pooled(one),), (_pooled(two),)
        low, high = newcombe_interval(*two[0], *one[0])
        return two[0][0] / two[0][1] - one[0][0] / one[0][1], low, high
    return _welch([s / n for s, n in one], [s / n for s, n in two])


def _mean_and_half_width(values: Sequence[float]) -> tuple[float, float]:
    """Mean and half of Student's 95 % interval."""
    deviation = float(np.std(values, ddof=1)) / math.sqrt(len(values))
    return float(np.mean(values)), float(student_t.ppf(0.975, len(values) - 1)) * deviation


def _welch(first: Sequence[float], other: Sequence[float]) -> tuple[float, float, float]:
    a, b = (float(np.var(x, ddof=1)) / len(x) for x in (first, other))
    middle = float(np.mean(other) - np.mean(first))
    freedom = (a + b) ** 2 / (a**2 / (len(first) - 1) + b**2 / (len(other) - 1))
    half = float(student_t.ppf(0.975, freedom)) * math.sqrt(a + b)
    return middle, middle - half, middle + half


def remarks(results: Sequence[RunResult]) -> list[str]:
    """Sentences about what makes the runs hard to compare."""
    said = []
    judged = [evaluation_config(result.config.env) for result in results]
    unlike = [
        name
        for name in flat_names(judged[0])
        if name in ("env", "task", "scene", "lift")
        and len({_option(config, name) for config in judged}) > 1
    ]
    if unlike:
        said.append(
            f"The runs were not judged in the same environment: {', '.join(unlike)} differ."
        )
    overs = {share.over for result in results if (share := result.share) is not None}
    if len(overs) > 1:
        said.append(
            "Some intervals are over episodes, others over seeds; only the latter say how much "
            "another seed would differ."
        )
    elif overs == {"episodes"}:
        said.append("Intervals are over episodes; another seed may differ more.")
    return said


def different_options(results: Sequence[RunResult]) -> list[tuple[str, tuple[str, ...]]]:
    """The options in which the runs differ, and the value of each run."""
    names: dict[str, None] = {}
    for result in results:
        names |= dict.fromkeys(flat_names(result.config))
    rows = []
    for name in names:
        values = tuple(_option(result.config, name) for result in results)
        if name not in _UNINTERESTING and len(set(values)) > 1:
            rows.append((name.replace("_", "-"), values))
    return rows


def _option(config: Any, name: str) -> str:
    return show_option(get_option(config, name)) if name in flat_names(config) else _NONE


def describe(results: Sequence[RunResult]) -> str:
    """Runs side by side as lines of text."""
    parts = [text_table(_table(results)), *remarks(results)]
    options = different_options(results)
    if options:
        head = ("option", *(result.name for result in results))
        parts.append(text_table([head, *((name, *values) for name, values in options)]))
    return "\n\n".join(parts)


def to_json(results: Sequence[RunResult]) -> list[dict[str, Any]]:
    """Runs side by side as a JSON array."""
    return [
        {
            "name": result.name,
            "seeds": len(result.folders),
            "success": None if result.share is None else dataclasses.asdict(result.share),
            "difference": difference(results[0], result) if result is not results[0] else None,
            "env_steps": result.env_steps,
            "wall_s": result.wall_s,
            "reached": dict(zip(map(str, _LEVELS), result.reached, strict=True)),
        }
        for result in results
    ]


def _table(results: Sequence[RunResult]) -> list[tuple[str, ...]]:
    levels = [f"{100 * level:.0f} % after" for level in _LEVELS]
    head = ("run", "seeds", "success", "95 % interval", "minus the first", "steps", "time", *levels)
    return [head, *(_row(result, results[0]) for result in results)]


def _row(result: RunResult, first: RunResult) -> tuple[str, ...]:
    share = result.share
    rate, bounds, against = _NONE, _NONE, _NONE
    if share is not None:
        rate, bounds = percent(share.rate), f"{interval(share.low, share.high)}, {share.over}"
    if result is not first and (change := difference(first, result)) is not None:
        middle, low, high = (100 * x for x in change)
        against = f"{middle:+.1f} ({low:+.1f} to {high:+.1f})"
    reached = (
        _NONE if at is None else f"{at[0]:,.0f} steps, {duration(at[1])}" for at in result.reached
    )
    return (
        result.name,
        str(len(result.folders)),
        rate,
        bounds,
        against,
        f"{result.env_steps:,}",
        duration(result.wall_s),
        *reached,
    )


def write_comparison(results: Sequence[RunResult], path: pathlib.Path) -> None:
    """Writes runs side by side as a page of HTML in one file.

    Raises:
      ValueError: the page cannot be written there.
    """
    if path.suffix != ".html" or not path.absolute().parent.is_dir():
        raise ValueError(f"{path} cannot be written: give a path ending in .html in a folder")
    html.write_page(path, html.document("Comparison of runs: mjx_arm", _page(results)))


def _page(results: Sequence[RunResult]) -> Iterator[str]:
    head, *rows = _table(results)
    yield "<h1>Comparison of runs</h1>"
    yield f'<p class="quiet">{html.text(", ".join(result.name for result in results))}</p>'
    yield "<h2>Success</h2>"
    yield html.table([[html.text(cell) for cell in row] for row in rows], head)
    for remark in remarks(results):
        yield f'<p class="quiet">{html.text(remark)}</p>'
    yield "<h2>Curves</h2>"
    yield (
        '<p class="quiet">One colour for each run. Thick lines are smoothed; with several seeds '
        "they are the mean, and the band reaches from the least to the largest seed. Diamonds are "
        "held-out episodes.</p>"
    )
    units: dict[str, str] = {}
    for result in results:
        units |= find_task(result.config.env.task).units
    groups = {result.name: result.folders for result in results}
    yield html.pictures(draw_groups(groups, units=units))
    options = different_options(results)
    if options:
        yield "<h2>Options that differ</h2>"
        cells = [[html.text(x) for x in (name, *values)] for name, values in options]
        yield html.table(cells, ("option", *(result.name for result in results)))
    yield "<footer>This page is one file. It opens without a network.</footer>"
