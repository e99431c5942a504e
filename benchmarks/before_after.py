"""Throughput of this checkout over that of an older one, stage by stage, in alternating rounds.

    git worktree add ../before COMMIT
    python benchmarks/before_after.py ../before --json benchmarks/results/before_after.json

Each round runs `throughput.py` in both checkouts, each time with the other one first, so that a
machine which changes its speed slows both. A stage's figure is the ratio after / before of a round.
The table has the median of the ratios and, as an interval of 96 % for 9 rounds, their second least
and second greatest. A benchmark beside another process means nothing: the file has the load.
"""

from __future__ import annotations

import argparse
import json
import os
import pathlib
import statistics
import subprocess
import sys
import tempfile
from typing import Any

from machine import machine

HERE = pathlib.Path(__file__).parents[1]


def measure(tree: pathlib.Path, arguments: list[str]) -> dict[str, float]:
    """Rates of the stages in one checkout, steps, frames or updates per second."""
    with tempfile.TemporaryDirectory() as folder:
        path = pathlib.Path(folder) / "rows.json"
        subprocess.run(
            [sys.executable, "benchmarks/throughput.py", *arguments, "--json", str(path)],
            cwd=tree,
            env=os.environ | {"PYTHONPATH": str(tree.resolve())},
            check=True,
            stdout=subprocess.DEVNULL,
        )
        rows = json.loads(path.read_text())["rows"]
    return {
        f"{row['stage']}, {row['backend']}, {row['num_envs']}": row["steps_per_s"] for row in rows
    }


def summarise(rounds: list[dict[str, dict[str, float]]]) -> list[dict[str, Any]]:
    """For each stage the median rates, and the median of the ratios with its interval."""
    rows = []
    for stage in rounds[0]["before"]:
        before, after = ([x[which][stage] for x in rounds] for which in ("before", "after"))
        ratios = sorted(b / a for a, b in zip(before, after, strict=True))
        inner = 1 if len(ratios) >= 5 else 0
        rows.append(
            {
                "stage": stage,
                "before": statistics.median(before),
                "after": statistics.median(after),
                "ratio": round(statistics.median(ratios), 3),
                "low": round(ratios[inner], 3),
                "high": round(ratios[-1 - inner], 3),
                "rounds": [round(x, 3) for x in ratios],
            }
        )
    return rows


def main() -> None:
    """Measures, prints a table and, where asked to, writes the file after each round."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("before", type=pathlib.Path, help="folder of the older checkout")
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--num-envs", nargs="+", default=["64"])
    parser.add_argument("--work", default="4096", help="environment steps of a timed chunk")
    parser.add_argument("--json", type=pathlib.Path, help="file for the results")
    options = parser.parse_args()
    arguments = ["--num-envs", *options.num_envs, "--work", options.work]
    arguments += ["--shadows", "0", "--storages", "states"]
    trees = {"before": options.before, "after": HERE}
    commits = {
        name: subprocess.run(
            ["git", "rev-parse", "--short", "HEAD"],
            cwd=tree,
            check=True,
            capture_output=True,
            text=True,
        ).stdout.strip()
        for name, tree in trees.items()
    }
    rounds: list[dict[str, dict[str, float]]] = []
    loads = []
    for i in range(options.rounds):
        order = sorted(trees, reverse=i % 2 == 0)
        rounds.append({name: measure(trees[name], arguments) for name in order})
        loads.append(round(os.getloadavg()[0], 2))
        table = summarise(rounds)
        if options.json:
            report = {"machine": machine(), "commits": commits, "load": loads, "rows": table}
            options.json.write_text(json.dumps(report, indent=1) + "\n")
    print(f"{'stage, physics, environments':<36}{'before':>10}{'after':>10}{'ratio':>8}  interval")
    for row in table:
        print(
            f"{row['stage']:<36}{row['before']:>10,.0f}{row['after']:>10,.0f}{row['ratio']:>8.3f}"
            f"  {row['low']:.3f} to {row['high']:.3f}"
        )


if __name__ == "__main__":
    main()
