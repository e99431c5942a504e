"""How well the control loop keeps its rate, driving the stand-in in its own process.

    python benchmarks/deploy.py agent-b --seconds 600 --json benchmarks/results/deploy.json

At 25 and at 50 actions a second, each for the given time: share of the deadlines that were missed,
time of the policy, age of the image when the action is sent, images lost on the way, and how many
episodes succeeded. After a success or 400 actions the cube goes back and the next episode begins.
"""

from __future__ import annotations

import argparse
import json
import pathlib
import tempfile
import time
from typing import Any

import numpy as np
from machine import machine

from mjx_arm.deploy.guard import make_guard
from mjx_arm.deploy.log import Log
from mjx_arm.deploy.loop import LoopConfig, run_loop
from mjx_arm.deploy.standin_robot import StandInRobot
from mjx_arm.deploy.standin_server import StandInProcess
from mjx_arm.export import export_policy
from mjx_arm.policy import Policy
from mjx_arm.standin.levels import LEVELS, find_level
from mjx_arm.tools.transfer import sample_starts
from mjx_arm.training.agent import Agent, load_agent
from mjx_arm.training.evaluate import wilson_interval

SEED, STARTS = 7, 64
# An episode in which the agent chooses this many actions has failed.
MOST_ACTIONS = 400


def measure(
    agent: Agent, rate: float, options: argparse.Namespace, folder: pathlib.Path
) -> dict[str, Any]:
    """One rate, for a time; logs go to a folder, since writing them is part of the loop."""
    policy = Policy(export_policy(agent))
    guard = make_guard(agent.env.scene, agent.env.arm)
    starts = sample_starts(agent.env, SEED, STARTS)
    outcomes, successes, complete = [], 0, 0
    faults: list[str] = []
    with (
        StandInProcess(agent.env, find_level(options.level), starts) as process,
        StandInRobot(process.port) as robot,
    ):
        ends = time.monotonic() + options.seconds
        while time.monotonic() < ends:
            left = ends - time.monotonic()
            number = len(outcomes)
            robot.reset(number % STARTS)
            config = LoopConfig(
                rate=rate,
                seconds=min(left, MOST_ACTIONS / rate),
                epsilon=0.1,
                watchdog=options.watchdog,
                seed=SEED + number,
            )
            path = folder / f"deploy-{rate:g}-{number}.jsonl"
            with Log(path, {"rate": rate}) as lines:
                outcome = run_loop(
                    robot,
                    policy,
                    guard,
                    config,
                    lines,
                    until=lambda: bool(robot.measured("success")),
                )
            if outcome.ending == "fault":
                faults.append(outcome.reason)
            outcomes.append(outcome)
            succeeded = outcome.reason == "the task is done"
            successes += succeeded
            # The last episode may have been cut off by the end of the measurement.
            complete += succeeded or left >= MOST_ACTIONS / rate
        lost = 1 - robot.received / robot.sent
    inference = np.concatenate([x.inference_ms for x in outcomes])
    ages = np.concatenate([x.image_age_ms for x in outcomes])
    ticks, misses = sum(x.ticks for x in outcomes), sum(x.misses for x in outcomes)
    skipped = sum(x.skipped for x in outcomes)
    return {
        "rate": rate,
        "seconds": options.seconds,
        "level": options.level,
        "ticks": ticks,
        "misses": misses,
        "skipped": skipped,
        "missed_share": (misses + skipped) / (ticks + skipped),
        "faults": faults,
        "watchdog": options.watchdog,
        "rejected": sum(x.rejected for x in outcomes),
        "inference_ms": {
            "median": float(np.median(inference)),
            "p99": float(np.percentile(inference, 99)),
            "largest": float(inference.max()),
        },
        "image_age_ms": {
            "median": float(np.median(ages)),
            "p99": float(np.percentile(ages, 99)),
        },
        "images_lost": lost,
        "episodes": complete,
        "successes": successes,
        "ci95": wilson_interval(successes, complete) if complete else None,
    }


def main() -> None:
    """Measures both rates, prints each and, where asked to, writes them."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("agent", help="name of a shipped agent, a file or a run folder")
    parser.add_argument("--rates", nargs="+", type=float, default=(25.0, 50.0))
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument("--level", choices=tuple(LEVELS), default="test")
    parser.add_argument("--scene", help="by default the one that the agent was trained in")
    parser.add_argument("--watchdog", type=float, default=0.3, help="oldest image, s")
    parser.add_argument("--logs", type=pathlib.Path, help="folder to keep the logs in")
    parser.add_argument("--json", type=pathlib.Path, help="file to write the results to")
    options = parser.parse_args()
    agent = load_agent(options.agent, scene=options.scene)
    rows = []
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.logs or pathlib.Path(temporary)
        for rate in options.rates:
            rows.append(measure(agent, rate, options, folder))
            print(json.dumps(rows[-1]), flush=True)
    if options.json:
        report = {"machine": machine(), "agent": options.agent, "rows": rows}
        options.json.write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
