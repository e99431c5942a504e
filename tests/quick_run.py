"""The command line without what takes most of a short run: its last evaluation and its video."""

from __future__ import annotations

from typing import Any

from mjx_arm.cli import run
from mjx_arm.training import runner
from mjx_arm.training.evaluate import Evaluation


class _NoFrames(list):
    success = False


def _evaluate(*args: Any, episodes: int, **options: Any) -> Evaluation:
    return Evaluation(episodes, 0, 0.0, (0.0, 1.0), 0.0, {})


# What takes the place of functions in `mjx_arm.training.runner`.
REPLACED = {
    "evaluate": _evaluate,
    "record_episode": lambda *args, **options: _NoFrames(),
    "draw_episode": lambda *args: iter(()),
    "write_video": lambda *args: None,
}

if __name__ == "__main__":
    for name, function in REPLACED.items():
        setattr(runner, name, function)
    run()
