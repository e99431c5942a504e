"""A search for options by Optuna: many short runs, of which the hopeless ones are ended early."""

from __future__ import annotations

import dataclasses
import importlib
import json
import math
import pathlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from rich.console import Console

from mjx_arm.config import TrainConfig, dump_config, set_train_options
from mjx_arm.envs.tasks import find_task
from mjx_arm.options import Count, Positive, check_value
from mjx_arm.report import html
from mjx_arm.report.figures import draw_groups
from mjx_arm.report.run_page import percent
from mjx_arm.tools.search_space import Dimension, check_space, suggest
from mjx_arm.tools.zoo import text_table
from mjx_arm.training.run_folder import CONFIG
from mjx_arm.training.runner import RunInterruptedError, train

_JOURNAL = "sweep.journal"
_PAGE = "sweep.html"
# Trials whose curves are shown.
_SHOWN = 5


@dataclasses.dataclass(frozen=True)
class Trial:
    """One run of a sweep.

    Attributes:
      number: from 0 on.
      state: `complete`, `pruned`, `running` or `fail`.
      value: success rate of the evaluation at its end, None where there was none.
      last: the last success rate of a selection, None where there was none.
      values: of the options that were varied.
      folder: its run folder.
    """

    number: int
    state: str
    value: float | None
    last: float | None
    values: dict[str, Any]
    folder: pathlib.Path


def sweep(
    config: TrainConfig,
    space: Sequence[Dimension],
    folder: str | pathlib.Path,
    *,
    trials: int = 20,
    minutes: float | None = None,
    eval_episodes: int = 100,
    console: Console | None = None,
) -> list[Trial]:
    """Trains with many values of some options, and ranks them by success.

    Optuna's TPE sampler suggests the values. A trial ends early where its best selection is below
    the median of the complete trials at the same step. Each trial is a run folder like any other,
    without the video. A sweep that was stopped continues when it is started again with the same
    folder; the trial that was cut off counts as failed, and another one takes its place.

    Args:
      config: the options that do not vary; `select_every` must be above 0.
      space: the options that vary.
      folder: of the sweep.
      trials: number of trials, those before a stop included.
      minutes: start no trial after this time.
      eval_episodes: episodes of the evaluation at the end of a trial.
      console: where it prints; by default nowhere.

    Returns:
      The trials, the best first.

    Raises:
      ValueError: the extra `sweep` is missing, options do not fit, or the folder is that of
        another sweep.
      RunInterruptedError: Ctrl-C or a signal; the page shows the trials so far.
    """
    optuna = import_optuna()
    check_value("trials", Count, trials)
    check_value("minutes", Positive | None, minutes)
    check_space(space, config)
    if config.select_every == 0:
        raise ValueError("select_every must be above 0: a sweep compares trials by selections")
    folder = pathlib.Path(folder)
    console = Console(quiet=True) if console is None else console
    study = _open_study(optuna, folder, config, space, trials)

    def objective(trial: Any) -> float:
        return _run_trial(optuna, trial, config, space, folder, eval_episodes, console)

    failed = optuna.trial.TrialState.FAIL
    left = trials - sum(trial.state != failed for trial in study.trials)
    try:
        if left > 0:
            study.optimize(objective, left, timeout=None if minutes is None else 60 * minutes)
    except RunInterruptedError:
        raise RunInterruptedError(
            f"stopped; the same command with --out {folder} goes on with the sweep"
        ) from None
    finally:
        ranked = _rank(study, folder)
        units = find_task(config.env.task).units
        html.write_page(
            folder / _PAGE, html.document("Sweep: mjx_arm", _page(ranked, space, units))
        )
    return ranked


def import_optuna() -> Any:
    """Optuna, with its own lines on the screen turned off.

    Raises:
      ValueError: the extra `sweep` is missing.
    """
    try:
        optuna = importlib.import_module("optuna")
    except ImportError:
        raise ValueError("a sweep needs the extra 'sweep': pip install 'mjx-arm[sweep]'") from None
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    return optuna


def _open_study(
    optuna: Any,
    folder: pathlib.Path,
    config: TrainConfig,
    space: Sequence[Dimension],
    trials: int,
) -> Any:
    """The study in a folder, or a new one."""
    journal = folder / _JOURNAL
    if not journal.is_file() and folder.exists() and any(folder.iterdir()):
        raise ValueError(f"{folder} is not empty and holds no sweep: give --out a new folder")
    folder.mkdir(parents=True, exist_ok=True)
    storage = optuna.storages.JournalStorage(
        optuna.storages.journal.JournalFileBackend(str(journal))
    )
    study = optuna.create_study(
        study_name="mjx_arm",
        storage=storage,
        direction="maximize",
        pruner=optuna.pruners.MedianPruner(n_startup_trials=max(1, min(5, trials // 3))),
        load_if_exists=True,
    )
    # A sweep that continues must not sample the first values again.
    study.sampler = optuna.samplers.TPESampler(seed=config.seed + len(study.trials))
    made_of = {
        "config": dump_config(config),
        "space": [dataclasses.asdict(dimension) for dimension in space],
    }
    # Through JSON, in which tuples are lists.
    made_of = json.loads(json.dumps(made_of))
    before = study.user_attrs.get("made_of", made_of)
    if before != made_of:
        raise ValueError(f"{folder} holds a sweep with other options: give --out another folder")
    study.set_user_attr("made_of", made_of)
    for trial in study.get_trials(states=[optuna.trial.TrialState.RUNNING]):
        study.tell(trial.number, state=optuna.trial.TrialState.FAIL)
    return study


def _run_trial(
    optuna: Any,
    trial: Any,
    config: TrainConfig,
    space: Sequence[Dimension],
    folder: pathlib.Path,
    eval_episodes: int,
    console: Console,
) -> float:
    values = suggest(trial, space)
    shown = ", ".join(f"{name.replace('_', '-')} {_shown(x)}" for name, x in values.items())
    console.print(f"trial {trial.number}: {shown}", soft_wrap=True)
    try:
        options = set_train_options(config, values)
    except ValueError as error:
        # Values that fit one by one need not fit together.
        console.print(f"trial {trial.number}: pruned, {error}", soft_wrap=True)
        raise optuna.TrialPruned(str(error)) from None

    def look(rows: list[dict[str, float]], state: Any) -> None:
        del state
        rate = float(np.mean([row["selection_rate"] for row in rows]))
        if math.isnan(rate):
            return
        steps = int(rows[0]["env_steps"])
        trial.report(rate, steps)
        if trial.should_prune():
            console.print(
                f"trial {trial.number}: pruned after {steps:,} steps at {percent(rate)}",
                soft_wrap=True,
            )
            raise optuna.TrialPruned

    quiet, own = Console(quiet=True), _trial_folder(folder, trial.number)
    try:
        results = train(
            options,
            own,
            eval_episodes=eval_episodes,
            on_chunk=look,
            video=False,
            console=quiet,
        )
    except ValueError as error:
        if (own / CONFIG).is_file():
            raise  # it had begun: a full disk, say, would end the other trials too
        # Such as options that need more memory than there is.
        console.print(f"trial {trial.number}: pruned, {error}", soft_wrap=True)
        raise optuna.TrialPruned(str(error)) from None
    rate = float(np.mean([result.rate for result in results]))
    console.print(f"trial {trial.number}: {percent(rate)} of {eval_episodes} episodes")
    return rate


def _trial_folder(folder: pathlib.Path, number: int) -> pathlib.Path:
    return folder / f"trial-{number:03d}"


def _rank(study: Any, folder: pathlib.Path) -> list[Trial]:
    """The trials: complete ones by their value, then the others by how they last did."""
    found = [
        Trial(
            number=trial.number,
            state=trial.state.name.lower(),
            value=trial.value if trial.state.name == "COMPLETE" else None,
            last=trial.intermediate_values[trial.last_step] if trial.intermediate_values else None,
            values=dict(trial.params),
            folder=_trial_folder(folder, trial.number),
        )
        for trial in study.trials
    ]
    return sorted(found, key=_order)


def _order(trial: Trial) -> tuple[float, float, int]:
    value = -1.0 if trial.value is None else trial.value
    return -value, -(-1.0 if trial.last is None else trial.last), trial.number


def describe_sweep(trials: Sequence[Trial], space: Sequence[Dimension]) -> str:
    """The trials as a table of text, the best first."""
    return text_table(_table(trials, space))


def _table(trials: Sequence[Trial], space: Sequence[Dimension]) -> list[tuple[str, ...]]:
    names = [dimension.name for dimension in space]
    head = ("trial", "state", "success", "last selection", *(x.replace("_", "-") for x in names))
    return [head, *(_row(trial, names) for trial in trials)]


def _row(trial: Trial, names: Sequence[str]) -> tuple[str, ...]:
    rates = ("–" if x is None else percent(x) for x in (trial.value, trial.last))
    values = (_shown(trial.values.get(name, "–")) for name in names)
    return (trial.folder.name, trial.state, *rates, *values)


def _shown(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def _page(
    trials: Sequence[Trial], space: Sequence[Dimension], units: Mapping[str, str]
) -> Iterator[str]:
    head, *rows = _table(trials, space)
    yield "<h1>Sweep</h1>"
    complete, pruned = (
        sum(trial.state == state for trial in trials) for state in ("complete", "pruned")
    )
    yield (
        f'<p class="quiet">{complete} trials complete, {pruned} pruned. '
        "Success is that of the evaluation at the end of a trial; a pruned trial has none.</p>"
    )
    yield "<h2>Trials</h2>"
    yield html.table([[html.text(cell) for cell in row] for row in rows], head)
    groups = {}
    for trial in trials[:_SHOWN]:
        folders = _folders_with_metrics(trial.folder)
        if folders:
            groups[trial.folder.name] = folders
    if groups:
        yield f"<h2>Curves of the best {len(groups)}</h2>"
        yield html.pictures(draw_groups(groups, units=units))
    yield "<footer>This page is one file. It opens without a network.</footer>"


def _folders_with_metrics(folder: pathlib.Path) -> list[pathlib.Path]:
    seeds = sorted(folder.glob("seed-*")) or [folder]
    return [seed for seed in seeds if (seed / "metrics.jsonl").is_file()]
