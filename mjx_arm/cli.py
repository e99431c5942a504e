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
import re
import signal
import sys
import typing
from collections.abc import Sequence
from types import FrameType
from typing import Annotated, Any, NoReturn

import jax
import tyro
from rich.console import Console

from mjx_arm.config import TrainConfig, set_train_options
from mjx_arm.options import check_name, describe, flat_names, get_option, groups
from mjx_arm.presets import PRESETS
from mjx_arm.report.figures import plot_curves
from mjx_arm.report.video import check_video_path, draw_episode, record_episode, write_video
from mjx_arm.training.agent import Agent, differences, load_agent
from mjx_arm.training.evaluate import evaluate
from mjx_arm.training.loop import EVALUATION, role_key
from mjx_arm.training.run_folder import load_config, parse_run, read_text, seed_folders
from mjx_arm.training.runner import RunInterruptedError, resume, train

# Options that may change when a run is resumed.
_CHANGEABLE = frozenset({"resume", "total_steps", "eval_episodes", "stop_at"})


@dataclasses.dataclass(frozen=True)
class Train:
    """Train an arm from pixels to grasp a cube and lift it.

    Attributes:
      preset: starting point of all other options. `fast`: the default on a CPU; a teacher that
        sees the simulator's state learns, and an agent that sees pixels alone learns from it.
        `pixels`: no network ever sees the state. `smoke`: everything once, within 3 minutes.
        `paper`: the values of James & Johns 2016. `gpu`: the default on an accelerator, `fast` with
        thousands of environments.
      config: a JSON file with options to start from instead of a preset, such as the `config.json`
        of a run.
      options: options of the run.
      out: folder for everything the run leaves; by default `runs/` and the time.
      resume: folder of a run to continue; only `--total-steps`, `--eval-episodes` and `--stop-at`
        may then be given.
      init_from: an agent or a run folder whose network the run starts from.
      stop_at: end the run when an evaluation that selects has reached this success rate.
      eval_episodes: episodes of the evaluation at the end, by the best agent, at epsilon 0.1 and on
        starts and random numbers that neither training nor the selection has seen.
    """

    options: Annotated[TrainConfig, tyro.conf.arg(name="")]
    preset: str = "fast"
    config: pathlib.Path | None = None
    out: pathlib.Path | None = None
    resume: pathlib.Path | None = None
    init_from: pathlib.Path | None = None
    stop_at: float | None = None
    eval_episodes: int = 200

    def run(self, given: frozenset[str]) -> None:
        """Runs the command; `given` are the names of the options on the command line."""
        console = Console(highlight=False)
        if self.resume is not None:
            self._resume(self.resume, given, console)
            return
        if self.config is None:
            console.print(f"preset: {self.preset}")
        train(
            self.options,
            self.out,
            eval_episodes=self.eval_episodes,
            stop_at=self.stop_at,
            init_from=self.init_from,
            console=console,
        )

    def _resume(self, folder: pathlib.Path, given: frozenset[str], console: Console) -> None:
        saved = load_config(folder)
        names = flat_names(saved)
        for name in sorted(given - _CHANGEABLE):
            value = get_option(self.options, name) if name in names else self
            if name == "physics" and value == "auto":
                continue
            if name not in names or value != get_option(saved, name):
                option = name.replace("_", "-")
                raise ValueError(f"--{option} cannot change when a run is resumed; leave it out")
        resume(
            folder,
            total_steps=self.options.total_steps if "total_steps" in given else None,
            eval_episodes=self.eval_episodes,
            stop_at=self.stop_at,
            console=console,
        )


@dataclasses.dataclass(frozen=True)
class _Try:
    """What the commands that try an agent have in common.

    Attributes:
      agent: an agent's file, or a run folder, of which the best agent is taken.
      env: environment, `A` or `B`; by default the one it was trained in.
      physics: backend; by default native on a CPU and mjx on other devices.
      epsilon: share of random actions.
      seed: of starts and random actions.
      max_steps: iterations until an episode is truncated.
    """

    agent: tyro.conf.Positional[pathlib.Path]
    env: str | None = None
    physics: str | None = None
    epsilon: float = 0.1
    seed: int = 7
    max_steps: int = 1_000

    def load(self) -> Agent:
        if not 0 <= self.seed < 2**31:
            raise ValueError(f"seed must be from 0 to {2**31 - 1}, got {self.seed}")
        options = {"env": self.env, "physics": self.physics}
        given = {name: value for name, value in options.items() if value is not None}
        return load_agent(self.agent, max_steps=self.max_steps, **given)

    def key(self) -> jax.Array:
        return role_key(self.seed, EVALUATION)


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
            agent.apply,
            agent.params,
            episodes=self.episodes,
            epsilon=self.epsilon,
            key=self.key(),
        )
        report = dataclasses.asdict(result)
        if self.json:
            print(json.dumps(report))
            return
        for name, value in (report | report.pop("metrics")).items():
            print(f"{name:<22} {value}")
        for name, (trained, judged) in differences(agent.trained_env, agent.config.env).items():
            print(f"trained with {name} = {trained}, judged with {judged}")


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
            agent.env, agent.apply, agent.params, epsilon=self.epsilon, key=self.key()
        )
        write_video(self.out, draw_episode(agent.env, episode))
        print(f"{self.out}: {len(episode)} frames, success: {episode.success}")


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


def default_preset() -> str:
    """`gpu` on an accelerator, `fast` on a CPU."""
    return "fast" if jax.default_backend() == "cpu" else "gpu"


def _start(arguments: Sequence[str]) -> Train:
    """The options that a command line starts from: those of its preset or file, and its task's."""
    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    for name in ("preset", "config", "task", "algorithm"):
        first.add_argument(f"--{name}", nargs="?")
    known = first.parse_known_args(arguments)[0]
    preset = known.preset or default_preset()
    check_name("preset", preset, PRESETS)
    options = PRESETS[preset]
    if known.config is not None:
        if known.preset is not None:
            raise ValueError("--preset and --config exclude each other: give one of them")
        options = parse_run(read_text(pathlib.Path(known.config)), known.config).config
    parts = {"task": known.task, "algorithm": known.algorithm}
    chosen = {name: value for name, value in parts.items() if value is not None}
    return Train(options=set_train_options(options, chosen), preset=preset)


def _parse(arguments: Sequence[str]) -> Train | Eval | Play | Figures:
    """The command of a command line.

    Raises:
      ValueError: it does not fit.
    """
    # The default makes `--help` show the values of the preset, and the options of the task.
    with_preset = Annotated[Train, tyro.conf.subcommand("train", default=_start(arguments))]
    commands: Any = with_preset | Eval | Play | Figures
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            command: Train | Eval | Play | Figures = tyro.cli(
                commands,
                args=arguments,
                prog="mjx-arm",
                config=(
                    tyro.conf.OmitArgPrefixes,
                    tyro.conf.OmitSubcommandPrefixes,
                    tyro.conf.AvoidSubcommands,
                ),
            )
    except SystemExit as stop:
        if stop.code == 2:
            raise ValueError(_one_sentence(said.getvalue(), arguments)) from None
        raise
    return command


def _one_sentence(box: str, arguments: Sequence[str]) -> str:
    """What tyro says in a box with advice below the first line across, in our words."""
    rows = [line.strip("│ ") for line in box.splitlines()]
    message = " ".join(itertools.takewhile(lambda row: not row.startswith("─"), rows[1:]))
    own = re.match(r"Error parsing [^ ]*[.][^ ]*: (.*)", message)
    if own:  # the options have refused their values themselves
        return own[1]
    flag = re.search(r"--[a-z][a-z-]*", message)
    annotation = _annotation(flag[0]) if flag and flag[0] in arguments else None
    if flag and annotation is not None and not message.startswith("Unrecognized"):
        after = arguments[arguments.index(flag[0]) + 1 :]
        values = list(itertools.takewhile(lambda text: not text.startswith("--"), after))
        got = repr(" ".join(values)) if values else "nothing"
        name = flag[0][2:].replace("-", "_")
        return f"{name} must be {describe(annotation)}, got {got}; see --help"
    return f"{message.rstrip('.')}; see --help".replace("Unrecognized", "unknown")


def _annotation(flag: str) -> Any:
    """The type of the option that a flag sets, or None."""
    name = flag[2:].replace("-", "_")
    classes = [type(group) for config in PRESETS.values() for group in groups(config)]
    for cls in (*classes, Train, Eval, Play):
        hints = typing.get_type_hints(cls, include_extras=True)
        # The group `env` has an option `env`.
        if name in hints and not dataclasses.is_dataclass(hints[name]):
            return hints[name]
    return None


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command line.

    Returns:
      The exit status: 2 for invalid input or a disk that does not take the output, 130 for a run
      that was interrupted.
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

    Ctrl-C ends it at once, which damages no file; while a run trains, it saves first.
    """
    signal.signal(signal.SIGINT, _stop)
    sys.exit(main(arguments))


def _stop(number: int, frame: FrameType | None) -> NoReturn:
    """Ends the process at once.

    A KeyboardInterrupt would be lost inside of a compilation, or leave one running that crashes
    when Python shuts down around it.
    """
    # Not by print, which the signal may have interrupted.
    if os.isatty(1):
        os.write(1, b"\x1b[?25h")  # the cursor, which a progress bar hides
    os.write(2, b"stopped; a run that has started continues with --resume and its folder\n")
    os._exit(130)
