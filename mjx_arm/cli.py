"""The command line."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import io
import itertools
import json
import os
import pathlib
import signal
import sys
from collections.abc import Sequence
from types import FrameType
from typing import Annotated, Any, NoReturn

import tyro
from rich.console import Console

from mjx_arm.agent import Agent, load_agent, load_config
from mjx_arm.config import PRESETS, EnvConfig, TrainConfig
from mjx_arm.evaluate import evaluate
from mjx_arm.report.figures import plot_curves
from mjx_arm.report.video import check_video_path, draw_episode, record_episode, write_video
from mjx_arm.train import RunInterruptedError, resume, seed_folders, train


@dataclasses.dataclass(frozen=True)
class Train:
    """Train an arm from pixels to grasp a cube and lift it.

    Attributes:
      preset: starting point of all other options: `fast` reaches over 90 % in A on two CPU cores,
        `smoke` ends within 3 minutes, `paper` has the values of James & Johns 2016.
      config: options of the run.
      out: folder for everything the run leaves; by default `runs/` and the time.
      resume: folder of a run to go on with; of the options only `--total-steps` may then change.
      eval_episodes: episodes of the evaluation at the end, by the best agent, at epsilon 0.1 and on
        starts and random numbers that neither training nor the selection has seen.
    """

    config: Annotated[TrainConfig, tyro.conf.arg(name="")]
    preset: str = "fast"
    out: pathlib.Path | None = None
    resume: pathlib.Path | None = None
    eval_episodes: int = 200

    def run(self, given: frozenset[str]) -> None:
        """Runs the command; `given` are the names of the options on the command line."""
        if self.resume is not None:
            self._resume(self.resume, given)
            return
        console = Console(highlight=False)
        train(self.config, self.out, eval_episodes=self.eval_episodes, console=console)

    def _resume(self, folder: pathlib.Path, given: frozenset[str]) -> None:
        saved = load_config(folder)
        changed = given - {"resume", "total_steps", "eval_episodes"}
        for name in sorted(changed):
            value = getattr(self.config, name, None)
            if value != getattr(saved, name, folder) and (name, value) != ("physics", "auto"):
                option = name.replace("_", "-")
                raise ValueError(f"--{option} cannot change when a run goes on; leave it out")
        resume(
            folder,
            total_steps=self.config.total_steps if "total_steps" in given else None,
            eval_episodes=self.eval_episodes,
            console=Console(highlight=False),
        )


@dataclasses.dataclass(frozen=True)
class _Try:
    """What the commands that try an agent have in common.

    Attributes:
      agent: an agent's file, or a run folder, of which the best agent is taken.
      env: environment, `A` or `B`; by default the one it was trained in.
      physics: backend; by default native on CPU and mjx elsewhere.
      epsilon: share of random actions.
      seed: of starts and random actions.
      max_steps: iterations until an episode is truncated.
    """

    agent: tyro.conf.Positional[pathlib.Path]
    env: str | None = None
    physics: str | None = None
    epsilon: float = 0.1
    seed: int = 7
    max_steps: int = EnvConfig.max_steps

    def load(self) -> Agent:
        if not 0 <= self.seed < 2**31:
            raise ValueError(f"seed is {self.seed}: give 0 to {2**31 - 1}")
        options = {"env": self.env, "physics": self.physics}
        given = {name: value for name, value in options.items() if value is not None}
        return load_agent(self.agent, max_steps=self.max_steps, **given)


@dataclasses.dataclass(frozen=True)
class Eval(_Try):
    """Try an agent for a number of episodes, and print how many succeeded.

    Attributes:
      episodes: how many.
      json: print one JSON object.
    """

    episodes: int = 1000
    json: bool = False

    def run(self, given: frozenset[str]) -> None:
        """Runs the command."""
        del given
        agent = self.load()
        result = evaluate(
            agent.env,
            agent.dqn.apply,
            agent.params,
            episodes=self.episodes,
            epsilon=self.epsilon,
            seed=self.seed,
        )
        report = dataclasses.asdict(result)
        if self.json:
            print(json.dumps(report))
            return
        for name, value in report.items():
            print(f"{name:<12} {value}")


@dataclasses.dataclass(frozen=True)
class Play(_Try):
    """Record one episode of an agent as a video.

    Attributes:
      out: the video, ending in `.mp4` or `.gif`.
    """

    out: pathlib.Path = pathlib.Path("video.mp4")

    def run(self, given: frozenset[str]) -> None:
        """Runs the command."""
        del given
        check_video_path(self.out)
        agent = self.load()
        episode = record_episode(
            agent.env, agent.dqn.apply, agent.params, epsilon=self.epsilon, seed=self.seed
        )
        write_video(self.out, draw_episode(agent.env, episode))
        print(f"{self.out}: {len(episode.qpos)} frames, success: {episode.success}")


@dataclasses.dataclass(frozen=True)
class Figures:
    """Draw the curves of a run again.

    Attributes:
      folder: a run folder.
    """

    folder: tyro.conf.Positional[pathlib.Path]

    def run(self, given: frozenset[str]) -> None:
        """Runs the command."""
        del given
        config = load_config(self.folder)
        for path in plot_curves(seed_folders(self.folder, config), into=self.folder):
            print(path)


def _parse(arguments: Sequence[str]) -> Train | Eval | Play | Figures:
    """The command of a command line.

    Raises:
      ValueError: it does not fit.
    """
    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    first.add_argument("--preset", nargs="?", default="fast")
    preset = first.parse_known_args(arguments)[0].preset
    if preset not in PRESETS:
        raise ValueError(f"unknown preset {preset!r}: give one of {', '.join(PRESETS)}")
    start = Train(config=PRESETS[preset], preset=preset)
    # The default makes `--help` show the values of the preset.
    with_preset = Annotated[Train, tyro.conf.subcommand("train", default=start)]
    commands: Any = with_preset | Eval | Play | Figures
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            command: Train | Eval | Play | Figures = tyro.cli(
                commands, args=arguments, prog="mjx-arm"
            )
    except SystemExit as stop:
        if stop.code == 2:
            raise ValueError(_one_sentence(said.getvalue())) from None
        raise
    return command


def _one_sentence(box: str) -> str:
    """What tyro says in a box with advice below the first line across."""
    rows = [line.strip("│ ") for line in box.splitlines()]
    message = itertools.takewhile(lambda row: not row.startswith("─"), rows[1:])
    return f"{' '.join(message).rstrip('.')}; see --help".replace("Unrecognized", "unknown")


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command line.

    Returns:
      The exit status: 2 for input that does not fit or a disk that does not take the output, 130
      for a run that was interrupted.
    """
    arguments = sys.argv[1:] if arguments is None else arguments
    names = (x[2:].split("=")[0] for x in arguments if x.startswith("--"))
    given = frozenset(name.removeprefix("no-").replace("-", "_") for name in names)
    try:
        _parse(arguments).run(given)
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        print(f"error: {where}{error.strerror or error}", file=sys.stderr)
        return 2
    except RunInterruptedError as stop:
        print(stop, file=sys.stderr)
        return 130
    return 0


def run(arguments: Sequence[str] | None = None) -> NoReturn:
    """Runs the command line as a process of its own, and ends it.

    Ctrl-C ends it where it stands, which no file minds, except while a run trains and saves first.
    """
    signal.signal(signal.SIGINT, _stop)
    sys.exit(main(arguments))


def _stop(number: int, frame: FrameType | None) -> NoReturn:
    """Ends the process at once.

    A KeyboardInterrupt would be lost inside of a compilation, or leave one running that crashes
    when Python shuts down around it.
    """
    # Not by print, which may be what the signal came into.
    if os.isatty(1):
        os.write(1, b"\x1b[?25h")  # the cursor, which a progress bar hides
    os.write(2, b"stopped; a run that has begun goes on with --resume and its folder\n")
    os._exit(130)
