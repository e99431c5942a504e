"""The page: its parts in order, written as HTML and as Markdown from the files of its folder."""

from __future__ import annotations

import json
import pathlib
from collections.abc import Iterator
from typing import Any

from mjx_arm.config import dump_config, parse_config
from mjx_arm.options import flat_names, get_option
from mjx_arm.presets import PRESETS
from mjx_arm.report import html
from mjx_arm.report.run_page import duration, show_option
from mjx_arm.reproduce import agent_sections, standin_sections, study_sections
from mjx_arm.reproduce.blocks import (
    Block,
    Command,
    Fold,
    Heading,
    Picture,
    Source,
    Table,
    Text,
    to_html,
    to_markdown,
)
from mjx_arm.reproduce.plan import SECTIONS, Plan
from mjx_arm.reproduce.store import PICTURES, Measured
from mjx_arm.reproduce.subjects import WAYS

_TITLE = "3D Simulation for Robot Arm Control with Deep Q-Learning, reproduced"
PAGE, MARKDOWN = "index.html", "index.md"


def write_pages(plan: Plan) -> pathlib.Path:
    """Writes `index.html`, `index.md` and the plots, from the files of the cells alone.

    Returns:
      Path of the page.

    Raises:
      ValueError: the file of a cell is damaged.
    """
    blocks = list(page_blocks(plan))
    for block in blocks:
        if isinstance(block, Picture) and block.name.endswith(".svg"):
            (plan.store.folder / PICTURES / block.name).write_bytes(block.content)
    path = plan.store.folder / PAGE
    html.write_page(plan.store.folder / MARKDOWN, to_markdown(blocks, PICTURES))
    html.write_page(path, to_html(_TITLE, blocks))
    return path


def page_blocks(plan: Plan) -> Iterator[Block]:
    """All parts of the page."""
    yield from _head(plan)
    for section in (
        agent_sections.figure1,
        agent_sections.figure2,
        agent_sections.figure3,
        agent_sections.table1,
        agent_sections.figure4,
        agent_sections.regrasping,
        study_sections.reward,
        study_sections.paper,
        study_sections.ablations,
        agent_sections.failures,
        standin_sections.figure5,
        standin_sections.transfer,
    ):
        yield from section(plan)
    yield from _configurations(plan)
    yield from _times(plan)


def _head(plan: Plan) -> Iterator[Block]:
    yield Heading(_TITLE, 1)
    yield Text(
        "James & Johns 2016 (arXiv 1609.03759) taught a simulated robot arm to lift a cube by deep "
        "Q-learning from pixels. This page shows their tables and figures again, measured with "
        "mjx_arm. Every number comes from a file in `cells/` beside this page, which is named "
        "below it. What is not measured is named together with the command that measures it."
    )
    if plan.quick:
        yield Text(
            "This is a quick run: its episodes are few and short, and what it trains is tiny. It "
            "proves that the commands work; its figures are too uncertain to be quoted."
        )
    rows, files = [], []
    for subject in plan.subjects:
        steps = "–"
        found = plan.read(f"episodes-{subject.name}-in-{subject.trained_in}")
        if found is not None:
            steps = f"{found.result['env_steps']:,}"
            files.append(found.file)
        where = "only its curve" if subject.agent is None else f"`{subject.agent}`"
        rows.append(
            (subject.name, WAYS[subject.way], subject.trained_in, str(subject.seed), steps, where)
        )
    if rows:
        yield Heading("The agents")
        head = ("name", "training", "trained in", "seed", "steps", "where it is from")
        yield Table(head, tuple(rows))
        if files:
            yield Source(tuple(files))
    else:
        yield Text("There is no agent yet.")
    yield Text("The whole page is made by these commands; each says the hours before it trains:")
    longer = ("pixels", "reward", "paper", "ablations", "ablations-B")
    yield Command(
        (
            plan.command(),
            *(f"{plan.command(name)}  # {SECTIONS[name]}" for name in longer),
        )
    )


def _cells(plan: Plan) -> list[Measured]:
    found = (plan.read(cell.name) for cell in plan.cells)
    return [each for each in found if each is not None]


def _configurations(plan: Plan) -> Iterator[Block]:
    yield Heading("Configurations")
    for subject in plan.subjects:
        text = json.dumps(dump_config(subject.config), indent=1)
        yield Fold(f"{subject.name}: all options of its training", text)
    rows = []
    for cell in _cells(plan):
        if "config" in cell.inputs:
            config = parse_config(json.dumps(cell.inputs["config"]), cell.file)
            base = "paper" if cell.name.startswith("paper") else "fast"
            preset = PRESETS[base]
            changed = [
                f"`{name.replace('_', '-')}` {show_option(get_option(config, name))}"
                for name in flat_names(config)
                if name not in flat_names(preset)
                or get_option(config, name) != get_option(preset, name)
            ]
            rows.append((cell.name, base, str(config.seed), ", ".join(changed) or "–"))
    if rows:
        yield Table(("training", "preset", "seed", "options that differ from it"), tuple(rows))


def _times(plan: Plan) -> Iterator[Block]:
    yield Heading("Machine, versions and times")
    cells = _cells(plan)
    # Machines may differ in what is not printed.
    yield from map(Text, dict.fromkeys(_describe(cell.machine) for cell in cells))
    rows = [
        (f"`{cell.file}`", duration(cell.seconds), _training_time(cell), cell.date)
        for cell in cells
    ]
    yield Table(("file", "measuring", "training", "written"), tuple(rows))


def _describe(machine: dict[str, Any]) -> str:
    found = ", ".join(f"{name} {x}" for name, x in machine["versions"].items())
    flags = f" XLA_FLAGS: {machine['xla_flags']}." if machine["xla_flags"] else ""
    return (
        f"Measured on {machine['cpu']}, {machine['cores']} cores, device {machine['device']}, "
        f"Python {machine['python']}. {found}.{flags}"
    )


def _training_time(cell: Measured) -> str:
    seconds = cell.result.get("wall_s", cell.result.get("curve", {}).get("wall_s"))
    return "–" if seconds is None else duration(seconds)
