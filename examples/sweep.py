"""A search for options: short runs, of which Optuna ends the hopeless ones early.

`python examples/sweep.py 20` makes 20 trials; without a number it makes 2. Started again, it
continues. `mjx-arm sweep` does the same on the command line.
"""

from __future__ import annotations

import pathlib
import sys

from rich.console import Console

import mjx_arm
from mjx_arm.tools.search_space import parse_space
from mjx_arm.tools.sweep import describe_sweep, sweep


def main() -> None:
    """Searches learning rate and n-step of a learner that sees the state and reaches for a mark."""
    config = mjx_arm.train_config(
        task="reach",
        observation="state",
        num_envs=32,
        total_steps=49_152,
        chunk_steps=4_096,
        replay_size=40_000,
        learning_starts=2_000,
        epsilon_steps=20_000,
        max_steps=200,
        select_every=8_192,  # a trial may be pruned after each of these
        select_episodes=32,
    )
    space = parse_space(["learning-rate=1e-4..1e-2:log", "n-step=1..5"], config)
    trials = sweep(
        config,
        space,
        pathlib.Path("runs/sweep-reach"),
        trials=int(sys.argv[1]) if len(sys.argv) > 1 else 2,
        eval_episodes=50,
        console=Console(),
    )
    print(describe_sweep(trials, space))


if __name__ == "__main__":
    main()
