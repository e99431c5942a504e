"""How often a trained agent succeeds, and whether it matters by which backend it is judged.

For each run folder: how long it trained, 1,000 episodes of the best agent on the CPU's backend at
epsilon 0.1 with a seed that neither training nor selection has seen, 100 episodes under MJX, and
Newcombe's 95 % interval of the difference.

    python benchmarks/success.py runs/NAME [runs/NAME ...] --json benchmarks/results/success.json

Rows that the file has of other environments and seeds stay, each with the machine it is from.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import pathlib
from typing import Any

from machine import machine

from mjx_arm.config import dump_config
from mjx_arm.report.metrics import read_metrics
from mjx_arm.training.agent import find_agent, load_agent
from mjx_arm.training.evaluate import Evaluation, evaluate, newcombe_interval
from mjx_arm.training.loop import EVALUATION, role_key

_EPSILON = 0.1
_SEED = 7


def try_agent(folder: pathlib.Path, physics: str, episodes: int, env: str | None) -> Evaluation:
    """Evaluates the best agent of a run under a backend."""
    agent = load_agent(folder, physics=physics, env=env)
    options = {"episodes": episodes, "epsilon": _EPSILON, "key": role_key(_SEED, EVALUATION)}
    return evaluate(agent.env, agent.apply, agent.params, **options)


def report(
    folder: pathlib.Path, episodes: int, mjx_episodes: int, env: str | None
) -> dict[str, Any]:
    """One run's row."""
    agent, rows = load_agent(folder, env=env), read_metrics(folder)
    wall_s = {row["env_steps"]: row["wall_s"] for row in rows}
    native = try_agent(folder, "native", episodes, env)
    mjx = try_agent(folder, "mjx", mjx_episodes, env)
    return {
        "trained_in": agent.trained_env.env,
        "env": agent.config.env.env,
        "algorithm": agent.config.algorithm,
        "seed": agent.config.seed,
        "agent": find_agent(folder).name,
        "env_steps": agent.env_steps,
        "minutes_to_this_agent": wall_s[agent.env_steps] / 60,
        "minutes_of_training": rows[-1]["wall_s"] / 60,
        "native": dataclasses.asdict(native),
        "mjx": dataclasses.asdict(mjx),
        "native_minus_mjx": native.rate - mjx.rate,
        "newcombe_ci95": newcombe_interval(
            native.successes, native.episodes, mjx.successes, mjx.episodes
        ),
        "machine": machine(),
        "config": dump_config(agent.config),
    }


def write_row(path: pathlib.Path, row: dict[str, Any]) -> None:
    """Writes a row into a file of rows, in the place of one of the same environment and seed."""
    rows = json.loads(path.read_text())["rows"] if path.is_file() else []
    kept = sorted([other for other in rows if _name(other) != _name(row)] + [row], key=_name)
    path.write_text(json.dumps({"rows": kept}, indent=1) + "\n")


def _name(row: dict[str, Any]) -> tuple[Any, ...]:
    return row["algorithm"], row["trained_in"], row["env"], row["seed"]


def main() -> None:
    """Evaluates, prints a line a run and, where asked to, writes the figures to a file."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("runs", nargs="+", type=pathlib.Path, help="run folders")
    parser.add_argument("--episodes", type=int, default=1000)
    parser.add_argument("--env", choices=("A", "B"), help="by default the one it was trained in")
    parser.add_argument("--mjx-episodes", type=int, default=100)
    parser.add_argument("--json", type=pathlib.Path, help="file to write the results to")
    arguments = parser.parse_args()
    for folder in arguments.runs:
        row = report(folder, arguments.episodes, arguments.mjx_episodes, arguments.env)
        print(json.dumps({k: v for k, v in row.items() if k != "config"}))
        if arguments.json:
            write_row(arguments.json, row)


if __name__ == "__main__":
    main()
