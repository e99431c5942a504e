"""`mjx-arm reproduce`: trains what is missing, measures cell by cell, and writes the page."""

from __future__ import annotations

import datetime
import json
import pathlib
import time
from collections.abc import Sequence
from typing import Any

from rich.console import Console

from mjx_arm.report.machine import machine, versions
from mjx_arm.reproduce.page import write_pages
from mjx_arm.reproduce.plan import Cell, Plan, make_plan
from mjx_arm.reproduce.store import Measured
from mjx_arm.reproduce.trainings import Training, describe_hours, run_training


def reproduce(
    out: pathlib.Path,
    *,
    runs: pathlib.Path | None = None,
    shipped: bool = False,
    quick: bool = False,
    only: Sequence[str] = (),
    seeds: int = 1,
    console: Console | None = None,
) -> pathlib.Path:
    """Makes the page of the paper's tables and figures.

    A cell that has a file of the same agent and the same options is not measured again. What was
    interrupted continues when the same command is run again.

    Args:
      out: folder of the page: `index.html`, `index.md`, `cells/`, `pictures/` and `runs/`.
      runs: run folders whose agents are shown; nothing is trained for them.
      shipped: show the agents that come with the package where `runs` has none.
      quick: tiny trainings and few episodes, to prove the path.
      only: sections or cells to measure; by default everything but the long studies.
      seeds: number of seeds of each agent that is trained.
      console: where it prints; by default nowhere.

    Returns:
      Path of the page.

    Raises:
      ValueError: an unknown section, no run folder, damaged files, or a folder that cannot be
        written.
      RunInterruptedError: Ctrl-C or a signal while it trains.
    """
    console = Console(quiet=True) if console is None else console
    options: dict[str, Any] = {
        "runs": runs,
        "shipped": shipped,
        "quick": quick,
        "only": only,
        "seeds": seeds,
    }
    plan = make_plan(out, **options)
    plan.store.prepare()
    trainings = plan.wanted_trainings()
    _say_hours(trainings, console)
    for training in trainings:
        run_training(training, plan.run_folder(training), console)
    # Again: now there are the agents that were just trained.
    plan = make_plan(out, **options)
    for cell in plan.cells:
        if plan.is_chosen(cell.name, cell.section) and plan.read(cell.name) is None:
            _measure(plan, cell, console)
    # Once more: after the last ablation in A those in B are known.
    page = write_pages(make_plan(out, **options))
    console.print(f"page: {page}", soft_wrap=True)
    return page


def _say_hours(trainings: Sequence[Training], console: Console) -> None:
    if not trainings:
        return
    total = describe_hours(sum(training.hours for training in trainings))
    console.print(f"trainings: {len(trainings)}, about {total} on 2 cores")
    for training in trainings:
        console.print(f"  {training.name}: {describe_hours(training.hours)}")


def _measure(plan: Plan, cell: Cell, console: Console) -> None:
    started = time.perf_counter()
    console.print(f"measuring {cell.name}")
    try:
        inputs = json.loads(json.dumps(cell.inputs()))
        result, pictures = cell.measure()
    except ValueError as error:
        # The other cells do not depend on this one; the page says that it is missing.
        console.print(f"[yellow]{cell.name} is missing: {error}[/yellow]", soft_wrap=True)
        return
    measured = Measured(
        name=cell.name,
        command=plan.command(cell.name),
        inputs=inputs,
        result=result,
        pictures=tuple(sorted(pictures)),
        machine=machine() | {"versions": versions()},
        seconds=round(time.perf_counter() - started, 1),
        date=datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    )
    plan.store.write(measured, pictures)
