"""The paper's questions: an agent in its simulator and in the stand-in for reality, side by side.

    python benchmarks/transfer.py none=agent-b both=runs/desk --levels near medium --out FOLDER

For each agent and each world (its simulator, and each level of the stand-in), from both starts:
success at epsilon 0.1, and how often the gripper closes at the cube. An agent is `NAME=AGENT`, or
AGENT alone.

Files in FOLDER: `cell-NAME-WORLD-START.json`, one for each cell; and `transfer.json` with all cells
as `cells`, and every reading of a true level (near, medium, far) as `readings`. An agent is read at
true levels three times at most, so that nothing is tuned on them. If FOLDER is `cells` in that of
`mjx-arm reproduce`, its page shows the table.
"""

from __future__ import annotations

import argparse
import dataclasses
import datetime
import json
import pathlib
import time
from typing import Any

from machine import machine

from mjx_arm.reproduce.trials import agent_digest
from mjx_arm.standin.levels import LEVELS, find_level
from mjx_arm.tools.transfer import (
    ITERATIONS,
    Outcomes,
    in_simulation,
    in_standin,
    sample_starts,
    summarise,
)
from mjx_arm.training.agent import load_agent

EPSILON, SEED = 0.1, 7
STARTS = ("home", "in_grasp")
MOST_READINGS = 3
TABLE = "transfer.json"


def note_reading(folder: pathlib.Path, name: str, agent: str, **what: Any) -> None:
    """Lists a reading of true levels before it is made.

    Raises:
      ValueError: the agent has been read often enough.
    """
    table = read_table(folder)
    sha256 = agent_digest(agent)
    made = [reading for reading in table["readings"] if reading["sha256"] == sha256]
    if len(made) >= MOST_READINGS:
        dates = ", ".join(reading["date"] for reading in made)
        raise ValueError(f"{agent} has been read at true levels {len(made)} times: {dates}")
    now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    table["readings"].append({"agent": name, "sha256": sha256, "date": now, **what})
    write_table(folder, table)


def read_table(folder: pathlib.Path) -> dict[str, Any]:
    """What the folder has so far."""
    path = folder / TABLE
    if path.is_file():
        table: dict[str, Any] = json.loads(path.read_text())
        return table
    return {"machine": machine(), "cells": [], "readings": []}


def write_table(folder: pathlib.Path, table: dict[str, Any]) -> None:
    """Writes all cells."""
    (folder / TABLE).write_text(json.dumps(table, indent=1) + "\n")


def add_cell(folder: pathlib.Path, cell: dict[str, Any]) -> None:
    """Writes a cell, in the place of an older one of the same agent, world and start.

    Cells of another agent that had the same name are removed.
    """
    names = ("agent", "world", "start")
    table = read_table(folder)
    others = [x for x in table["cells"] if [x[n] for n in names] != [cell[n] for n in names]]
    same = [x for x in others if x["agent"] != cell["agent"] or x.get("sha256") == cell["sha256"]]
    for gone in (x for x in others if x not in same):
        _cell_path(folder, gone).unlink(missing_ok=True)
    table["cells"] = [*same, cell]
    write_table(folder, table)
    _cell_path(folder, cell).write_text(json.dumps({"machine": machine(), **cell}, indent=1) + "\n")


def _cell_path(folder: pathlib.Path, cell: dict[str, Any]) -> pathlib.Path:
    return folder / f"cell-{cell['agent']}-{cell['world']}-{cell['start']}.json"


def measure(agent: str, world: str, start: str, options: argparse.Namespace) -> Outcomes:
    """One cell of the table."""
    loaded = load_agent(agent, max_steps=ITERATIONS, start=start, scene=options.scene)
    episodes = options.episodes if start == "home" else options.in_grasp_episodes
    if world == "simulation":
        traces = in_simulation(loaded, SEED, episodes, epsilon=EPSILON)
    else:
        starts = sample_starts(loaded.env, SEED, episodes)
        traces = in_standin(loaded, find_level(world), starts, epsilon=EPSILON, seed=SEED)
    return summarise(traces, loaded.env)


def main() -> None:
    """Measures all cells, prints each, and writes them as they come."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("agents", nargs="+", help="NAME=AGENT or AGENT; names, files, run folders")
    parser.add_argument("--levels", nargs="+", choices=tuple(LEVELS), default=("near",))
    parser.add_argument("--starts", nargs="+", choices=STARTS, default=STARTS)
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--in-grasp-episodes", type=int, default=100)
    parser.add_argument("--scene", help="by default the one that an agent was trained in")
    parser.add_argument("--out", type=pathlib.Path, required=True, help="folder for the files")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    for given in options.agents:
        name, _, agent = given.rpartition("=")
        name = (name or pathlib.Path(agent).stem).replace("/", "_")
        true_levels = [level for level in options.levels if level != "test"]
        if true_levels:
            counts = {"home": options.episodes, "in_grasp": options.in_grasp_episodes}
            episodes = {start: counts[start] for start in options.starts}
            try:
                note_reading(options.out, name, agent, levels=true_levels, episodes=episodes)
            except ValueError as error:
                parser.error(str(error))
        for world in ("simulation", *options.levels):
            for start in options.starts:
                began = time.monotonic()
                outcomes = measure(agent, world, start, options)
                cell = {
                    "agent": name,
                    "sha256": agent_digest(agent),
                    "world": world,
                    "start": start,
                    "epsilon": EPSILON,
                    "seed": SEED,
                    **dataclasses.asdict(outcomes),
                }
                cell["seconds"] = round(time.monotonic() - began, 1)
                print(json.dumps(cell), flush=True)
                add_cell(options.out, cell)


if __name__ == "__main__":
    main()
