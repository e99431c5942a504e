"""Seconds from typing `train.py` to the end of the first trained chunk, without and with a cache.

Starts the command as a user would, with an empty compilation cache, and again with what the first
start left in it; stops it when the first line of metrics is there.

    python benchmarks/cold_start.py --json benchmarks/results/cold_start.json
    python benchmarks/cold_start.py --whole --preset smoke --json benchmarks/results/smoke.json

What is not an option of its own goes to `train.py`. With `--whole` the command is not stopped: its
evaluation, curves and video are in the time.
"""

from __future__ import annotations

import argparse
import json
import os
import pathlib
import signal
import statistics
import subprocess
import sys
import tempfile
import time

from machine import machine

_TRAIN = pathlib.Path(__file__).parents[1] / "train.py"


def start(cache: pathlib.Path, folder: pathlib.Path, arguments: list[str]) -> float:
    """Seconds until the first line of metrics."""
    environment = os.environ | {"JAX_COMPILATION_CACHE_DIR": str(cache)}
    command = [sys.executable, str(_TRAIN), "--out", str(folder), *arguments]
    begin = time.perf_counter()
    with subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL) as process:
        metrics = folder / "metrics.jsonl"
        while not (metrics.is_file() and metrics.read_text().endswith("\n")):
            if process.poll() is not None:
                raise RuntimeError(f"train.py ended with status {process.returncode}")
            time.sleep(0.02)
        seconds = time.perf_counter() - begin
        process.send_signal(signal.SIGKILL)
    return seconds


def run_whole(folder: pathlib.Path, arguments: list[str]) -> float:
    """Seconds until the command has ended."""
    command = [sys.executable, str(_TRAIN), "--out", str(folder), *arguments]
    begin = time.perf_counter()
    subprocess.run(command, stdout=subprocess.DEVNULL, check=True)
    return time.perf_counter() - begin


def main() -> None:
    """Measures, prints and, where asked to, writes the figures to a file."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--json", type=pathlib.Path, help="file to write the figures to")
    parser.add_argument("--whole", action="store_true", help="time the command to its end")
    options, arguments = parser.parse_known_args()
    names = ["whole"] if options.whole else ["cold", "warm"]
    seconds: dict[str, list[float]] = {name: [] for name in names}
    for _ in range(options.repeats):
        with tempfile.TemporaryDirectory() as scratch:
            cache = pathlib.Path(scratch) / "cache"
            for name, values in seconds.items():
                folder = pathlib.Path(scratch) / name
                whole = name == "whole"
                took = run_whole(folder, arguments) if whole else start(cache, folder, arguments)
                values.append(round(took, 2))
    medians = {name: statistics.median(values) for name, values in seconds.items()}
    said = ", ".join(f"{name} {median:.1f} s" for name, median in medians.items())
    print(f"{said}, of {options.repeats}")
    if options.json:
        report = {"machine": machine(), "arguments": arguments, "median": medians, "all": seconds}
        options.json.write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
