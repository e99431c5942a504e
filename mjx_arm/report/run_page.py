"""The page of a run: its curves, its video, its evaluation and its configuration, in one file."""

from __future__ import annotations

import dataclasses
import json
import math
import pathlib
import shlex
from collections.abc import Iterator, Sequence
from typing import Any

from mjx_arm.config import TrainConfig, set_train_options
from mjx_arm.envs.tasks import find_task
from mjx_arm.report import html
from mjx_arm.report.figures import draw_panels
from mjx_arm.report.metrics import read_metrics

REPORT = "report.html"
_VIDEO = "policy.mp4"
_EVALUATION = "evaluation.json"
# Options of the run itself, and of its groups, by the names of the fields.
_GROUPS = {
    "": "run",
    "env": "environment",
    "task_options": "task",
    "network": "network",
    "replay": "replay",
    "exploration": "exploration",
    "algo": "algorithm",
}


def write_report(
    folder: pathlib.Path, config: TrainConfig, seeds: Sequence[pathlib.Path]
) -> pathlib.Path:
    """Writes `report.html` of a run, from the files in its folder.

    What a folder lacks is left out, so that the page of a run can be written while it trains.

    Args:
      folder: of the run.
      config: its options.
      seeds: the folders of its seeds; the run folder itself if there is one seed.

    Returns:
      Path of the page.

    Raises:
      ValueError: a folder holds no metrics, or a file in it is damaged.
    """
    title = folder.resolve().name
    parts = [
        f"<h1>{html.text(title)}</h1>",
        f'<p class="quiet">{html.text(_subtitle(config))}</p>',
        *(_of_one_seed(folder) if len(seeds) == 1 else _of_seeds(folder, seeds)),
        "<h2>Curves</h2>",
        f'<p class="quiet">{_legend(len(seeds))}</p>',
        html.pictures(draw_panels(seeds, units=find_task(config.env.task).units)),
        *(_evaluation_section(folder) if len(seeds) == 1 else ()),
        "<h2>Configuration</h2>",
        '<p class="quiet">Bold options differ from the defaults that the documentation lists under '
        "Options. Presets change some of these.</p>",
        _configuration(config),
        "<h2>What to do with it</h2>",
        html.commands(_commands(folder, seeds)),
        "<footer>This page is one file. It opens without a network.</footer>",
    ]
    path = folder / REPORT
    html.write_page(path, html.document(f"{title}: mjx_arm", parts))
    return path


def read_evaluation(folder: pathlib.Path) -> dict[str, Any] | None:
    """The result of the evaluation at the end of a run, or None where there is none yet.

    Raises:
      ValueError: the file is damaged.
    """
    path = folder / _EVALUATION
    if not path.is_file():
        return None
    try:
        values: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        low, high = values["ci95"]
        numbers = [values[name] for name in ("episodes", "successes", "rate", "mean_length")]
        if all(isinstance(x, int | float) for x in (*numbers, low, high)):
            return values
    except (ValueError, KeyError, TypeError):
        pass
    raise ValueError(f"{path} is damaged: remove it, and evaluate the run again")


def percent(share: float) -> str:
    """A share as a percentage with one decimal, or a dash where it is unknown."""
    return "–" if math.isnan(share) else f"{100 * share:.1f} %"


def interval(low: float, high: float) -> str:
    """The bounds of a share as percentages."""
    return f"{100 * low:.1f} to {100 * high:.1f}"


def duration(seconds: float) -> str:
    """Seconds as hours and minutes, or as minutes and seconds where there is no hour."""
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes}:{rest:02d} min"
    return f"{minutes // 60} h {minutes % 60:02d} min"


def _subtitle(config: TrainConfig) -> str:
    seeds = f"{config.num_seeds} seeds from" if config.num_seeds > 1 else "seed"
    return (
        f"task {config.env.task}, environment {config.env.env}, algorithm {config.algorithm}, "
        f"{seeds} {config.seed}"
    )


def _legend(seeds: int) -> str:
    what = "each line is a seed, the dashed one their mean" if seeds > 1 else "the line is training"
    return (
        f"Thin lines are the chunks, thick lines their smoothed mean: {what}. "
        "Diamonds are held-out episodes of the agent."
    )


def _of_one_seed(folder: pathlib.Path) -> Iterator[str]:
    rows = read_metrics(folder)
    evaluation = read_evaluation(folder)
    selections = [x for row in rows if not math.isnan(x := row.get("selection_rate", math.nan))]
    figures = []
    if evaluation is not None:
        low, high = evaluation["ci95"]
        note = f"{interval(low, high)}, 95 % interval over episodes"
        figures.append((percent(evaluation["rate"]), "success, held-out episodes", note))
    if selections:
        figures.append((percent(max(selections)), f"best of {len(selections)} selections", ""))
    speeds = sorted(row["steps_per_s"] for row in rows if "steps_per_s" in row)
    figures.append((f"{int(rows[-1]['env_steps']):,}", "environment steps", ""))
    figures.append((duration(rows[-1]["wall_s"]), "training time", ""))
    if speeds:
        figures.append((f"{speeds[len(speeds) // 2]:,.0f}", "steps per second, median", ""))
    yield html.cards(figures)
    video = folder / _VIDEO
    if video.is_file():
        source = html.data_uri(video.read_bytes(), ".mp4")
        yield "<h2>One episode</h2>"
        yield f'<video controls loop muted playsinline preload="auto" src="{source}"></video>'
        yield '<p class="quiet">Left: the scene. Right: what the agent sees.</p>'


def _of_seeds(folder: pathlib.Path, seeds: Sequence[pathlib.Path]) -> Iterator[str]:
    yield "<h2>Seeds</h2>"
    rows = []
    for seed in seeds:
        last = read_metrics(seed)[-1]
        evaluation = read_evaluation(seed)
        link = f'<a href="{html.text(seed.name)}/{REPORT}">{html.text(seed.name)}</a>'
        rate, bounds = "–", "–"
        if evaluation is not None:
            rate, bounds = percent(evaluation["rate"]), interval(*evaluation["ci95"])
        rows.append((link, rate, bounds, f"{int(last['env_steps']):,}", duration(last["wall_s"])))
    head = ("seed", "success", "95 % interval over episodes", "environment steps", "training time")
    yield html.table(rows, head)


def _evaluation_section(folder: pathlib.Path) -> Iterator[str]:
    evaluation = read_evaluation(folder)
    yield "<h2>Evaluation</h2>"
    if evaluation is None:
        yield "<p>The run has not been evaluated yet.</p>"
        return
    low, high = evaluation["ci95"]
    rows = [
        ("episodes", f"{evaluation['episodes']:,}"),
        ("successes", f"{evaluation['successes']:,}"),
        ("success rate", f"{percent(evaluation['rate'])} (95 % interval {interval(low, high)})"),
        ("mean length of an episode", f"{evaluation['mean_length']:.0f} steps"),
    ]
    for name, value in evaluation.get("metrics", {}).items():
        rows.append((html.text(_describe(name)), _number(name, value)))
    yield html.table(rows)


def _describe(name: str) -> str:
    """What a metric of an evaluation says, in words; see `training.evaluate.Evaluation`."""
    for ending, words in (
        ("_failed_rate", "episodes with '{}' that failed"),
        ("_rate", "episodes with '{}'"),
        ("_again", "times that '{}' came again in an episode, mean"),
    ):
        if name.endswith(ending):
            return words.format(name.removesuffix(ending).replace("_", " "))
    return name.replace("_", " ")


def _number(name: str, value: float) -> str:
    return percent(value) if name.endswith("_rate") else f"{value:.3g}"


def _configuration(config: TrainConfig) -> str:
    start = {"task": config.env.task, "algorithm": config.algorithm}
    default = set_train_options(TrainConfig(), start)
    sections = [_group(name, rows, changed) for name, rows, changed in _groups(config, default)]
    return f'<div class="groups">{"".join(sections)}</div>'


def _group(name: str, rows: list[tuple[str, str]], changed: list[int]) -> str:
    return f"<section><h3>{html.text(name)}</h3>{html.table(rows, (), changed)}</section>"


def _groups(
    config: Any, default: Any, name: str = ""
) -> Iterator[tuple[str, list[tuple[str, str]], list[int]]]:
    """Each group of options: its name, its options and values, and which differ from default."""
    rows: list[tuple[str, str]] = []
    changed, inner = [], []
    for field in dataclasses.fields(config):
        value, usual = getattr(config, field.name), getattr(default, field.name)
        if dataclasses.is_dataclass(value):
            inner.append((field.name, value, usual))
            continue
        if value != usual:
            changed.append(len(rows))
        rows.append((html.text(field.name.replace("_", "-")), html.text(show_option(value))))
    if rows:
        yield _GROUPS.get(name, name), rows, changed
    for group, value, usual in inner:
        yield from _groups(value, usual, group)


def show_option(value: Any) -> str:
    """The value of an option as it is read best."""
    if isinstance(value, tuple):
        return " ".join(map(show_option, value))
    if isinstance(value, int) and value >= 10_000:
        return f"{value:,}"
    return str(value) or "–"


def _commands(folder: pathlib.Path, seeds: Sequence[pathlib.Path]) -> list[str]:
    run, agent = shlex.quote(str(folder)), shlex.quote(str(seeds[0]))
    lines = {
        f"mjx-arm view {agent}": "watch it, push the cube, see its Q-values",
        f"mjx-arm play {agent} --out video.mp4": "record another video",
        f"mjx-arm eval {agent} --episodes 1000": "its success rate, with an interval",
        f"mjx-arm train --resume {run}": "continue it",
    }
    width = max(map(len, lines))
    return [f"{command.ljust(width)}  # {what}" for command, what in lines.items()]


__all__: Sequence[str] = (
    "REPORT",
    "duration",
    "interval",
    "percent",
    "read_evaluation",
    "show_option",
    "write_report",
)
