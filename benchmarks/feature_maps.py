"""Figure 5 of James & Johns 2016: feature maps for one moment in the simulator and in the stand-in.

    python benchmarks/feature_maps.py none=agent-b both=runs/desk --out FOLDER
    python benchmarks/feature_maps.py taught-B-seed0=agent-b --page FOLDER

An agent is `NAME=AGENT`, or AGENT alone. Files in FOLDER: `figure5.png`, the maps of every layer,
side by side; and `figure5.json`, for each agent the cosine similarity of each layer, at the moment
of the picture (`picture`) and as a mean over the episodes of several starts (`mean`). With `--page`
FOLDER is that of `mjx-arm reproduce`, whose page shows them.

The level is `test` by default. The other levels are those at which agents are judged: an agent may
be read there three times at most.
"""

from __future__ import annotations

import argparse
import json
import os
import pathlib
import sys
from typing import Any

import numpy as np
from machine import machine

from mjx_arm.reproduce.trials import agent_digest
from mjx_arm.standin.levels import LEVELS, find_level
from mjx_arm.standin.opengl import find_opengl
from mjx_arm.tools.feature_maps import Comparison, compare_moments, draw_comparisons, to_json
from mjx_arm.tools.transfer import ITERATIONS
from mjx_arm.training.agent import load_agent

SEED = 7


def means(comparisons: list[Comparison]) -> list[dict[str, Any]]:
    """Similarity of each layer, and of other moments, over several moments."""
    return [
        {
            "name": layers[0].name,
            "similarity": float(np.mean([layer.similarity for layer in layers])),
            "other_moments": float(np.mean([layer.yardstick for layer in layers])),
        }
        for layers in zip(*(comparison.layers for comparison in comparisons), strict=True)
    ]


def make_parser() -> argparse.ArgumentParser:
    """Makes what reads the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("agents", nargs="+", help="NAME=AGENT or AGENT; names, files, run folders")
    parser.add_argument("--level", choices=tuple(LEVELS), default="test")
    parser.add_argument("--starts", type=int, default=8, help="moments for the means")
    parser.add_argument("--scene", help="by default the one that an agent was trained in")
    places = parser.add_mutually_exclusive_group(required=True)
    places.add_argument("--out", type=pathlib.Path, help="folder for the files")
    places.add_argument("--page", type=pathlib.Path, help="folder of `mjx-arm reproduce`")
    return parser


def write_files(options: argparse.Namespace, rows: dict[str, Any], picture: bytes) -> pathlib.Path:
    """Writes both files where the options say, and returns the path of the picture."""
    tables = pictures = options.out
    if options.page is not None:
        tables, pictures = options.page / "cells", options.page / "pictures"
    for folder in (tables, pictures):
        folder.mkdir(parents=True, exist_ok=True)
    report = {"machine": machine(), "level": options.level, "agents": rows}
    (tables / "figure5.json").write_text(json.dumps(report, indent=1) + "\n")
    path: pathlib.Path = pictures / "figure5.png"
    path.write_bytes(picture)
    return path


def main() -> None:
    """Compares, draws and writes."""
    options = make_parser().parse_args()
    if not os.environ.get("MUJOCO_GL") and find_opengl():
        # MuJoCo chooses its OpenGL when it is imported: once more, with one without a screen.
        os.environ["MUJOCO_GL"] = find_opengl()
        os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])
    rows: dict[str, Any] = {}
    pictures = []
    for given in options.agents:
        name, _, path = given.rpartition("=")
        name = name or pathlib.Path(path).stem
        agent = load_agent(path, max_steps=ITERATIONS, scene=options.scene)
        level = find_level(options.level)
        found = compare_moments(agent, level, seed=SEED, episodes=options.starts)
        pictures.append((name, found[0]))
        rows[name] = {
            "sha256": agent_digest(path),
            "picture": to_json(found[0]),
            "mean": means(found),
            "moments": len(found),
        }
        print(name, json.dumps(rows[name]["mean"]), flush=True)
    print(write_files(options, rows, draw_comparisons(pictures)))


if __name__ == "__main__":
    main()
