"""Figure 5 of James & Johns 2016: feature maps for one moment in the simulator and in the stand-in.

    python benchmarks/feature_maps.py none=agent-b both=runs/desk --level near --out FOLDER

An agent is `NAME=AGENT`, or AGENT alone. Files in FOLDER: `figure5.png`, the maps of every layer,
side by side; and `figure5.json`, for each agent the cosine similarity of each layer, at the moment
of the picture (`picture`) and as a mean over the episodes of several starts (`mean`).
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


def main() -> None:
    """Compares, draws and writes."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("agents", nargs="+", help="NAME=AGENT or AGENT; names, files, run folders")
    parser.add_argument("--level", choices=tuple(LEVELS), default="near")
    parser.add_argument("--starts", type=int, default=8, help="moments for the means")
    parser.add_argument("--scene", help="by default the one that an agent was trained in")
    parser.add_argument("--out", type=pathlib.Path, required=True, help="folder for the files")
    options = parser.parse_args()
    if not os.environ.get("MUJOCO_GL") and find_opengl():
        # MuJoCo chooses its OpenGL when it is imported: once more, with one without a screen.
        os.environ["MUJOCO_GL"] = find_opengl()
        os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])
    options.out.mkdir(parents=True, exist_ok=True)
    rows: dict[str, Any] = {}
    pictures = []
    for given in options.agents:
        name, _, path = given.rpartition("=")
        name = name or pathlib.Path(path).stem
        agent = load_agent(path, max_steps=ITERATIONS, scene=options.scene)
        level = find_level(options.level)
        found = compare_moments(agent, level, seed=SEED, episodes=options.starts)
        pictures.append((name, found[0]))
        rows[name] = {"picture": to_json(found[0]), "mean": means(found), "moments": len(found)}
        print(name, json.dumps(rows[name]["mean"]), flush=True)
    report = {"machine": machine(), "level": options.level, "agents": rows}
    (options.out / "figure5.json").write_text(json.dumps(report, indent=1) + "\n")
    (options.out / "figure5.png").write_bytes(draw_comparisons(pictures))
    print(options.out / "figure5.png")


if __name__ == "__main__":
    main()
