"""One process of one device against two processes, each on a core of its own.

    python benchmarks/processes.py --json benchmarks/results/processes.json

All variants train the same: the preset `fast` in B once the student acts, with as many environments
and as large batches in all. They take turns. The share of the exchange is what a step takes longer
than one without the averages over the processes; waiting for the slower process is part of it.
Needs Linux, two cores and a machine that does nothing else: the file says how busy it was before.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import pathlib
import socket
import statistics
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import jax
from machine import machine
from throughput import time_chunks

import mjx_arm
from mjx_arm.config import TrainConfig, set_train_options
from mjx_arm.shard import Shard
from mjx_arm.training.loop import make_trainer
from mjx_arm.training.mesh import make_mesh
from mjx_arm.training.processes import end_together, join_processes

ROOT = pathlib.Path(__file__).parents[1]
# Cores of each process.
VARIANTS = {
    "1 process, 1 core": [[0]],
    "1 process, 2 cores": [[0, 1]],
    "2 processes, a core each": [[0], [1]],
}
_TINY: dict[str, Any] = {
    "size": (16, 16),
    "num_envs": 8,
    "replay_size": 800,
    "widths": (4, 4, 4),
    "hidden": 16,
    "teacher_hidden": 16,
    "teacher_batch_size": 16,
    "student_batch_size": 8,
    "chunk_steps": 80,
}

Row = dict[str, Any]


def config(*, tiny: bool) -> TrainConfig:
    """What all variants train."""
    options = {"env": "B", "learning_starts": 0, "student_starts": 0, "chunk_steps": 2_048}
    # The student drives from the first step on, so that every part of a step is there.
    options |= {"student_warm_up": 0}
    return set_train_options(mjx_arm.PRESETS["fast"], options | (_TINY if tiny else {}))


@contextlib.contextmanager
def without_exchange() -> Iterator[None]:
    """What is traced in this block averages and adds up nothing over the devices."""
    names = ("mean", "total", "largest")
    before = {name: getattr(Shard, name) for name in names}
    for name in names:
        setattr(Shard, name, lambda self, tree: tree)
    try:
        yield
    finally:
        for name, method in before.items():
            setattr(Shard, name, method)


def measure(*, tiny: bool) -> dict[str, float]:
    """Environment steps/s of all processes together, with and without the exchange."""
    mesh = make_mesh(1)
    found = {"with": _rate(config(tiny=tiny), mesh, tiny=tiny)}
    if mesh is not None:
        with without_exchange():
            found["without"] = _rate(config(tiny=tiny), mesh, tiny=tiny)
    return found


def _rate(config: TrainConfig, mesh: jax.sharding.Mesh | None, *, tiny: bool) -> float:
    trainer = make_trainer(config, mesh=mesh)
    state = [trainer.start()]

    def run() -> Any:
        state[0], counts = trainer.run_chunk(state[0])
        return counts

    # Once more, for the replay must fill before the first update.
    jax.block_until_ready(run())
    figures = time_chunks(run, config.chunk_length * config.num_envs, 1 if tiny else 5)
    return figures["steps_per_s"]


def start(variant: str, *, tiny: bool) -> dict[str, float]:
    """Measures a variant in processes of its own.

    Raises:
      RuntimeError: a process failed.
    """
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = free.getsockname()[1]
    cores = VARIANTS[variant]
    command = [sys.executable, __file__, *["--tiny"] * tiny, "--place", f"localhost:{port}"]
    path = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
    started = [
        subprocess.Popen(
            [*command, str(len(cores)), str(process), "--cores", *map(str, own)],
            env=os.environ | {"PYTHONPATH": path},
            stdout=subprocess.PIPE,
            text=True,
        )
        for process, own in enumerate(cores)
    ]
    said = [process.communicate()[0] for process in started]
    if any(process.returncode for process in started):
        raise RuntimeError(f"{variant}: a process failed, and its error is above")
    # Before it gloo reports its connections.
    return json.loads(said[0].splitlines()[-1])


def summarise(variant: str, rounds: list[dict[str, float]]) -> Row:
    """The row of a variant: the median over the rounds, and the share of the exchange."""
    rates = [found["with"] for found in rounds]
    shares = [1 - found["with"] / found["without"] for found in rounds if "without" in found]
    return {
        "variant": variant,
        "steps_per_s": round(statistics.median(rates)),
        "least": round(min(rates)),
        "most": round(max(rates)),
        # Below 0 where the rounds differ by more than the exchange takes.
        "exchange": max(0.0, statistics.median(shares)) if shares else None,
        "rounds": rounds,
    }


def main() -> None:
    """Measures all variants in turns; with `--place`, one process of one variant."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=pathlib.Path, help="file for the rows")
    parser.add_argument("--rounds", type=int, default=3, help="of all variants")
    parser.add_argument("--tiny", action="store_true", help="rehearse at sizes that mean nothing")
    parser.add_argument("--place", nargs=3, help=argparse.SUPPRESS)
    parser.add_argument("--cores", nargs="+", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.place:
        # Before jax and MuJoCo make their threads.
        os.sched_setaffinity(0, options.cores)
        coordinator, number, process = options.place
        join_processes(coordinator, int(number), int(process))
        print(json.dumps(measure(tiny=options.tiny)), flush=True)
        end_together(0)
        return
    busy = os.getloadavg()[0]
    rounds: dict[str, list[dict[str, float]]] = {variant: [] for variant in VARIANTS}
    for _ in range(options.rounds):
        for variant, found in rounds.items():
            found.append(start(variant, tiny=options.tiny))
    rows = [summarise(variant, found) for variant, found in rounds.items()]
    for row in rows:
        share = row["exchange"]
        said = "" if share is None else f", {100 * share:.0f} % for the exchange"
        print(f"{row['variant']}: {row['steps_per_s']:,} steps/s{said}")
    if options.json:
        used = config(tiny=options.tiny)
        about = {"machine": machine(), "load_before": busy, "num_envs": used.num_envs}
        options.json.write_text(json.dumps({**about, "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
