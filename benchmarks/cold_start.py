"""Seconds from typing `train.py` to the end of the first trained chunk, without and with a cache.

Starts the command as a user would, with an empty compilation cache, and again with what the first
start left in it; stops it when the first line of metrics is there.

    python benchmarks/cold_start.py --json benchmarks/results/cold_start.json
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


def main() -> None:
    """Measures, prints and, where asked to, writes the figures to a file."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--json", type=pathlib.Path, help="file to write the figures to")
    options, arguments = parser.parse_known_args()
    seconds: dict[str, list[float]] = {"cold": [], "warm": []}
    for _ in range(options.repeats):
        with tempfile.TemporaryDirectory() as scratch:
            cache = pathlib.Path(scratch) / "cache"
            for name, values in seconds.items():
                values.append(round(start(cache, pathlib.Path(scratch) / name, arguments), 2))
    medians = {name: statistics.median(values) for name, values in seconds.items()}
    print(f"cold {medians['cold']:.1f} s, warm {medians['warm']:.1f} s, of {options.repeats}")
    if options.json:
        report = {"machine": machine(), "arguments": arguments, "median": medians, "all": seconds}
        options.json.write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
