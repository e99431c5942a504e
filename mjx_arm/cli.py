"""The command line."""

from __future__ import annotations

import dataclasses
import datetime
import pathlib
import sys
from collections.abc import Sequence
from typing import Annotated

import tyro
from rich.console import Console

from mjx_arm.config import TrainConfig
from mjx_arm.train import train


@dataclasses.dataclass(frozen=True)
class TrainCommand:
    """Train an arm from pixels to grasp a cube and lift it.

    Attributes:
      config: options of the run.
      out: folder for everything the run leaves; by default `runs/` and the time.
      eval_episodes: episodes of the evaluation at the end.
    """

    config: Annotated[TrainConfig, tyro.conf.arg(name="")]
    out: pathlib.Path | None = None
    eval_episodes: int = 200


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command line; returns the exit status: 2 for input that does not fit."""
    try:
        command = tyro.cli(TrainCommand, args=arguments, prog="train.py")
        _train(command)
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


def _train(command: TrainCommand) -> None:
    now = datetime.datetime.now().strftime("%Y-%m-%d-%H%M%S")
    folder = command.out or pathlib.Path("runs") / f"{now}-{command.config.env}"
    train(
        command.config,
        folder,
        eval_episodes=command.eval_episodes,
        console=Console(highlight=False),
    )
