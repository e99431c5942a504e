"""The command line."""

from __future__ import annotations

import dataclasses
import datetime
import json
import pathlib
import sys
from collections.abc import Sequence
from typing import Annotated

import tyro
from rich.console import Console

from mjx_arm.agent import Agent, load_agent, load_config
from mjx_arm.config import EnvConfig, TrainConfig
from mjx_arm.evaluate import evaluate
from mjx_arm.report.figures import plot_curves
from mjx_arm.report.video import draw_episode, record_episode, write_video
from mjx_arm.train import RunInterruptedError, resume, train


@dataclasses.dataclass(frozen=True)
class Train:
    """Train an arm from pixels to grasp a cube and lift it.

    Attributes:
      config: options of the run.
      out: folder for everything the run leaves; by default `runs/` and the time.
      resume: folder of a run to go on with; of the options only `--total-steps` may then change.
      eval_episodes: episodes of the evaluation at the end.
    """

    config: Annotated[TrainConfig, tyro.conf.arg(name="")]
    out: pathlib.Path | None = None
    resume: pathlib.Path | None = None
    eval_episodes: int = 200

    def run(self, given: frozenset[str]) -> None:
        """Runs the command; `given` are the names of the options on the command line."""
        if self.resume is not None:
            self._resume(self.resume, given)
            return
        now = datetime.datetime.now().strftime("%Y-%m-%d-%H%M%S")
        folder = self.out or pathlib.Path("runs") / f"{now}-{self.config.env}"
        console = Console(highlight=False)
        train(self.config, folder, eval_episodes=self.eval_episodes, console=console)

    def _resume(self, folder: pathlib.Path, given: frozenset[str]) -> None:
        saved = load_config(folder)
        changed = given - {"resume", "total_steps", "eval_episodes"}
        for name in sorted(changed):
            if getattr(self.config, name, None) != getattr(saved, name, folder):
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
      agent: a run folder.
      env: environment, `A` or `B`; by default the one it was trained in.
      physics: backend; by default that of the run.
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
        config = load_config(self.agent)
        env, physics = self.env or config.env, self.physics or config.physics
        return load_agent(self.agent, max_steps=self.max_steps, env=env, physics=physics)


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
        for path in plot_curves(self.folder):
            print(path)


Command = Train | Eval | Play | Figures


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command line.

    Returns:
      The exit status: 2 for input that does not fit, 130 for a run that was interrupted.
    """
    arguments = sys.argv[1:] if arguments is None else arguments
    names = (x[2:].split("=")[0] for x in arguments if x.startswith("--"))
    given = frozenset(name.removeprefix("no-").replace("-", "_") for name in names)
    try:
        command: Command = tyro.cli(Command, args=arguments, prog="mjx-arm")
        command.run(given)
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except RunInterruptedError as stop:
        print(stop, file=sys.stderr)
        return 130
    return 0
