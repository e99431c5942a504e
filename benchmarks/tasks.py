"""How well the tasks `reach` and `push` are learnt from state features, in environment B.

Each task is trained by the preset `state` for a fixed number of environment steps. The agent that
the selection found best is then judged in 1,000 episodes at epsilon 0.1, with starts that neither
training nor selection has seen.

    python benchmarks/tasks.py --json benchmarks/results/tasks.json
    python benchmarks/tasks.py --tasks reach --runs FOLDER --json benchmarks/results/tasks.json

With `--runs`, a run that FOLDER holds already, such as `FOLDER/reach-0`, is judged as it is.

Results of tasks that are not trained again stay in the file, each with the machine it is from.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import os
import pathlib
import tempfile
from typing import Any

from machine import machine

import mjx_arm
from mjx_arm.config import dump_config, set_train_options
from mjx_arm.report.metrics import read_metrics
from mjx_arm.training.evaluate import evaluate
from mjx_arm.training.loop import EVALUATION, role_key
from mjx_arm.training.run_folder import load_config

# Environment steps of training, and the success rate to reach.
STEPS = {"reach": 500_000, "push": 1_500_000}
GOALS = {"reach": 0.95, "push": 0.85}
EPISODES = 1_000
EPSILON = 0.1
SEED = 7


def measure(task: str, seed: int, folder: pathlib.Path) -> dict[str, Any]:
    """Trains on one task, judges the best agent, and returns the task's row."""
    if not (folder / "config.json").is_file():
        options = {"task": task, "env": "B", "total_steps": STEPS[task], "seed": seed}
        config = set_train_options(mjx_arm.PRESETS["state"], options)
        mjx_arm.train(config, folder, eval_episodes=1)
    agent, rows = mjx_arm.load_agent(folder), read_metrics(folder)
    evaluation = evaluate(
        agent.env,
        agent.apply,
        agent.params,
        episodes=EPISODES,
        epsilon=EPSILON,
        key=role_key(SEED, EVALUATION),
    )
    return {
        "task": task,
        "seed": seed,
        "goal": GOALS[task],
        "agent_env_steps": agent.env_steps,
        "env_steps": rows[-1]["env_steps"],
        "minutes": rows[-1]["wall_s"] / 60,
        "epsilon": EPSILON,
        "evaluation": dataclasses.asdict(evaluation),
        "selections": [
            {
                "env_steps": row["env_steps"],
                "minutes": row["wall_s"] / 60,
                "rate": row["selection_rate"],
            }
            for row in rows
            if math.isfinite(row["selection_rate"])
        ],
        "load_average": os.getloadavg()[0],
        "machine": machine(),
        "config": dump_config(load_config(folder)),
    }


def write_row(path: pathlib.Path, row: dict[str, Any]) -> None:
    """Writes a row into a file of rows, in the place of one of the same task and seed."""
    rows = json.loads(path.read_text())["rows"] if path.is_file() else []
    kept = [x for x in rows if (x["task"], x["seed"]) != (row["task"], row["seed"])]
    kept = sorted([*kept, row], key=lambda x: (x["task"], x["seed"]))
    path.write_text(json.dumps({"rows": kept}, indent=1) + "\n")


def main() -> None:
    """Trains, judges, prints a line for each task and, where asked to, writes the file."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tasks", nargs="+", choices=list(STEPS), default=list(STEPS))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--runs", type=pathlib.Path, help="keep the run folders in this folder")
    parser.add_argument("--json", type=pathlib.Path, help="file to write the results to")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        runs = arguments.runs or pathlib.Path(temporary)
        for task in arguments.tasks:
            row = measure(task, arguments.seed, runs / f"{task}-{arguments.seed}")
            print(json.dumps({k: row[k] for k in ("task", "env_steps", "minutes", "evaluation")}))
            if arguments.json:
                write_row(arguments.json, row)


if __name__ == "__main__":
    main()
