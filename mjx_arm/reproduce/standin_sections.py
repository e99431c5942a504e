"""The parts of the page about the stand-in for reality: Figure 5 and the transfer.

Two benchmarks measure them, and leave their files in the page's folder.
"""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Iterator
from typing import Any, TypeAlias

from mjx_arm.report.run_page import interval, percent
from mjx_arm.reproduce.agent_sections import firsts, stored
from mjx_arm.reproduce.blocks import Block, Heading, Missing, Source, Table, Text
from mjx_arm.reproduce.plan import Plan
from mjx_arm.reproduce.store import CELLS, PICTURES
from mjx_arm.reproduce.subjects import Subject
from mjx_arm.reproduce.trials import agent_digest

_FIGURE5, _TRANSFER, _PICTURE = "figure5", "transfer", "figure5.png"
_LEVELS = ("near", "medium", "far")
_WORLDS = ("simulation", *_LEVELS)
_STARTS = ("home", "in_grasp")
# Agent, world and start -> a cell of `transfer.json`.
_Cells: TypeAlias = dict[tuple[str, str, str], dict[str, Any]]


def figure5(plan: Plan) -> Iterator[Block]:
    """Feature maps of each layer in the simulator and in the stand-in."""
    yield Heading("Figure 5: feature maps in two worlds")
    level, agents, table = _compared(plan)
    if agents:
        yield stored(
            plan,
            _PICTURE,
            "Feature maps of each layer for an image of the simulator and one of the stand-in, of "
            f"{', '.join(agents)}",
            "Left: the simulator, without randomisation. Right: the stand-in for reality at level "
            f"`{level}`, in the same state.",
        )
        yield table
        yield Text(
            "The similarity of a layer is the cosine between its outputs for the two images, as a "
            "mean over the moments of several episodes. Outputs after a rectifier are never "
            "negative, so any two images are similar: the last column compares the simulated image "
            "with other moments of its episode."
        )
        yield Source((f"{CELLS}/{_FIGURE5}.json",))
    missing = [subject for subject in _seeing(plan) if subject.name not in agents]
    if missing or not agents:
        yield Missing(
            f"Figure 5{_of(missing)}. Not made yet.",
            _python("feature_maps.py", *_arguments(_seeing(plan)), "--page", plan.store.folder),
        )


def _compared(plan: Plan) -> tuple[str, list[str], Table]:
    """Level, agents and similarities of the files of Figure 5; no agents if it is to be made.

    All agents are in one picture, so one that is not the page's own voids the others.
    """
    head = ("agent", "layer", "simulator and stand-in", "other moments")
    report = plan.store.read_report(_FIGURE5)
    if report is None or not (plan.store.folder / PICTURES / _PICTURE).is_file():
        return "", [], Table(head, ())
    try:
        agents = report["agents"]
        rows = [
            (name, layer["name"], f"{layer['similarity']:.3f}", f"{layer['other_moments']:.3f}")
            for name, each in agents.items()
            for layer in each["mean"]
        ]
        shown = all(_is_shown(plan, name, each["sha256"]) for name, each in agents.items())
        return report["level"], list(agents) if shown else [], Table(head, tuple(rows))
    except (KeyError, TypeError, ValueError, AttributeError):
        raise plan.store.damaged(_FIGURE5) from None


def transfer(plan: Plan) -> Iterator[Block]:
    """Success of agents in their simulator and in the stand-in."""
    yield Heading("The transfer to another world")
    found = _tried(plan)
    try:
        rows = tuple(_rows(found))
    except (KeyError, TypeError, ValueError):
        raise plan.store.damaged(_TRANSFER) from None
    if rows:
        yield Table(
            ("agent", "world", "success", "95 % interval", "closes at the cube",
             "success from the grasp", "its 95 % interval"),
            rows,
        )  # fmt: skip
        yield Text(
            "Success with one action in ten random (ε = 0.1), in the agent's own simulator and in "
            "the stand-in for reality, whose levels have fixed offsets of camera, colours and "
            "physics. 'Closes at the cube': of the steps with the open gripper within 3 cm of the "
            "cube, the share in which the agent closes it; an agent that closes further out has "
            "0 %. 'From the grasp': the cube is in the gripper at the start."
        )
        yield Source((f"{CELLS}/{_TRANSFER}.json",))
    yield from _missing_worlds(plan, found)


def _tried(plan: Plan) -> _Cells:
    """The cells of the benchmark, without those of agents that the page has now in another form."""
    report = plan.store.read_report(_TRANSFER)
    if report is None:
        return {}
    try:
        return {
            (cell["agent"], cell["world"], cell["start"]): cell
            for cell in report["cells"]
            if _is_shown(plan, cell["agent"], cell["sha256"])
        }
    except (KeyError, TypeError):
        raise plan.store.damaged(_TRANSFER) from None


def _rows(found: _Cells) -> Iterator[tuple[str, ...]]:
    for agent in dict.fromkeys(agent for agent, _, _ in found):
        for world in _WORLDS:
            home, grasp = (found.get((agent, world, start)) for start in _STARTS)
            if home is None and grasp is None:
                continue
            rate = None if home is None else home["close_rate"]
            closes = "–" if rate is None else percent(rate)
            yield agent, world, *_success(home), closes, *_success(grasp)


def _success(cell: dict[str, Any] | None) -> tuple[str, str]:
    if cell is None:
        return "–", "–"
    return f"{percent(cell['rate'])} of {cell['episodes']:,}", interval(*cell["ci95"])


def _missing_worlds(plan: Plan, found: _Cells) -> Iterator[Missing]:
    """The worlds in which the agents of the page were not tried, and the commands for them."""
    groups: dict[tuple[str, ...], list[Subject]] = {}
    for subject in _seeing(plan):
        missing = [
            world
            for world in _WORLDS
            if any((subject.name, world, start) not in found for start in _STARTS)
        ]
        if missing:
            groups.setdefault(tuple(missing), []).append(subject)
    if not found and not groups:
        groups[_WORLDS] = []
    for worlds, subjects in groups.items():
        # The simulator comes with each of them.
        levels = [world for world in worlds if world in _LEVELS] or list(_LEVELS)
        yield Missing(
            f"The transfer{_of(subjects)}: {', '.join(worlds)}. Not measured yet.",
            _python(
                "transfer.py", *_arguments(subjects), "--levels", *levels,
                "--out", plan.store.folder / CELLS,
            ),
        )  # fmt: skip


def _seeing(plan: Plan) -> list[Subject]:
    """The agents of the page that see images: the stand-in shows nothing else."""
    return [subject for subject in firsts(plan) if subject.config.env.observation != "state"]


def _is_shown(plan: Plan, name: str, sha256: str) -> bool:
    """Whether a benchmark's agent is the page's own of that name, or none of the page's names."""
    for subject in plan.subjects:
        if subject.name == name:
            try:
                return subject.agent is not None and agent_digest(subject.agent) == sha256
            except ValueError:
                return False
    return True


def _of(subjects: Iterable[Subject]) -> str:
    names = ", ".join(f"`{subject.name}`" for subject in subjects)
    return f" of {names}" if names else ""


def _arguments(subjects: Iterable[Subject]) -> list[str]:
    return [f"{subject.name}={subject.agent}" for subject in subjects] or ["NAME=AGENT"]


def _python(script: str, *words: object) -> str:
    return shlex.join(["python", f"benchmarks/{script}", *map(str, words)])
