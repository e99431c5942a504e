"""The command line."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import io
import json
import os
import pathlib
import signal
import sys
import typing
from collections.abc import Sequence
from types import FrameType
from typing import Annotated, Any, NoReturn, TypeVar

import jax
import tyro
from rich.console import Console

from mjx_arm.algos.exploration import check_epsilon
from mjx_arm.arguments import read_arguments
from mjx_arm.config import TrainConfig, set_train_options
from mjx_arm.devices import check_device
from mjx_arm.envs.randomisation import RandomisationConfig
from mjx_arm.options import check_name, flat_annotations, flat_names, get_option, option_names
from mjx_arm.presets import PRESETS
from mjx_arm.report.figures import plot_curves
from mjx_arm.report.progress import make_console
from mjx_arm.report.run_page import write_report
from mjx_arm.report.video import check_video_path, draw_episode, record_episode, write_video
from mjx_arm.tools.compare import describe, read_result, to_json, write_comparison
from mjx_arm.tools.search_space import parse_space
from mjx_arm.tools.sweep import describe_sweep, sweep
from mjx_arm.tools.wandb_log import WandbLog, import_wandb
from mjx_arm.tools.zoo import describe_zoo, read_shipped, read_zoo
from mjx_arm.training.agent import Agent, differences, load_agent
from mjx_arm.training.evaluate import evaluate
from mjx_arm.training.loop import EVALUATION, role_key
from mjx_arm.training.mesh import make_mesh
from mjx_arm.training.processes import (
    alone,
    end_together,
    is_writer,
    join_processes,
    lost_sentence,
    watch_others,
)
from mjx_arm.training.run_folder import (
    load_config,
    new_run_folder,
    parse_run,
    read_text,
    seed_folders,
)
from mjx_arm.training.runner import RunInterruptedError, resume, stop_signals, train
from mjx_arm.view.viewer import ViewOptions, view

_PROCESSES = ("coordinator", "num_processes", "process_id")
# Options that may change when a run is resumed.
_CHANGEABLE = frozenset(
    {"resume", "total_steps", "eval_episodes", "stop_at", "wandb", "devices", *_PROCESSES}
)


@dataclasses.dataclass(frozen=True)
class Train:
    """Train an arm from pixels to grasp a cube and lift it.

    Attributes:
      preset: starting point of all other options. `fast`: the default on a CPU; a teacher that
        sees the simulator's state learns, and an agent that sees pixels alone learns from it.
        `pixels`: no network ever sees the state. `state`: the agent sees the state, no image.
        `smoke`: everything once, within 3 minutes. `paper`: the values of James & Johns 2016.
        `gpu`: the default on an accelerator, `fast` with thousands of environments.
      config: a JSON file with options to start from instead of a preset, such as the `config.json`
        of a run.
      options: options of the run.
      out: folder for everything the run leaves; by default `runs/` and the time.
      resume: folder of a run to continue; only `--total-steps`, `--eval-episodes`, `--stop-at`,
        `--wandb` and the number of devices and processes may then be given.
      init_from: an agent or a run folder whose network the run starts from.
      stop_at: end the run when an evaluation that selects has reached this success rate.
      eval_episodes: episodes of the evaluation at the end, by the best agent, at epsilon 0.1 and on
        starts and random numbers that neither training nor the selection has seen.
      wandb: also log the run to Weights & Biases; `WANDB_MODE=offline` keeps it in the run folder.
      devices: number of local devices that share the work; by default as many as divide it.
      coordinator: `HOST:PORT` of process 0, where several processes train one run; each gets the
        same command with its own number. Under Slurm, Open MPI and Kubernetes leave all three out.
      num_processes: number of processes of the run.
      process_id: number of this process, from 0.
    """

    options: Annotated[TrainConfig, tyro.conf.arg(name="")]
    preset: str = "fast"
    config: pathlib.Path | None = None
    out: pathlib.Path | None = None
    resume: pathlib.Path | None = None
    init_from: pathlib.Path | None = None
    stop_at: float | None = None
    eval_episodes: int = 200
    wandb: bool = False
    devices: int | None = None
    coordinator: str | None = None
    num_processes: int | None = None
    process_id: int | None = None

    def run(self, given: frozenset[str]) -> None:
        """Runs the command; `given` are the names of the options on the command line."""
        console = make_console()
        check_device()
        watch_others()
        if self.resume is not None:
            self._resume(self.resume, given, console)
            return
        if self.config is None and is_writer():
            console.print(f"preset: {self.preset}")
        out = self.out
        if self.wandb and out is None:
            if not alone():
                raise ValueError("--wandb with several processes needs --out FOLDER")
            import_wandb()
            out = new_run_folder(self.options.env.env)
        with self._log(out) as on_chunk:
            train(
                self.options,
                out,
                eval_episodes=self.eval_episodes,
                stop_at=self.stop_at,
                init_from=self.init_from,
                on_chunk=on_chunk,
                devices=self.devices,
                console=console,
            )

    def _log(
        self, folder: pathlib.Path | None
    ) -> contextlib.AbstractContextManager[WandbLog | None]:
        if not self.wandb or folder is None or not is_writer():
            return contextlib.nullcontext()
        return WandbLog(folder)

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
        with self._log(folder) as on_chunk:
            resume(
                folder,
                total_steps=self.options.total_steps if "total_steps" in given else None,
                eval_episodes=self.eval_episodes,
                stop_at=self.stop_at,
                on_chunk=on_chunk,
                devices=self.devices,
                console=console,
            )


@dataclasses.dataclass(frozen=True)
class Sweep:
    """Search for options of a training by many short runs; hopeless ones are ended early.

    Every trial is a run folder. A sweep that was stopped continues with the same `--out`.

    Attributes:
      options: of all trials.
      search: options to vary: `learning-rate=1e-4..1e-2:log`, `n-step=1..5`, `hidden=128,256`.
      preset: starting point of all other options; see `train`.
      config: a JSON file with options to start from instead of a preset.
      out: folder of the sweep.
      trials: number of trials.
      minutes: start no trial after this time.
      eval_episodes: episodes of the evaluation at the end of a trial.
    """

    options: Annotated[TrainConfig, tyro.conf.arg(name="")]
    search: tuple[str, ...] = ()
    preset: str = "fast"
    config: pathlib.Path | None = None
    out: pathlib.Path = pathlib.Path("runs/sweep")
    trials: int = 20
    minutes: float | None = None
    eval_episodes: int = 100

    def run(self, given: frozenset[str]) -> None:
        """Runs the command."""
        del given
        space = parse_space(self.search, self.options)
        console = make_console()
        found = sweep(
            self.options,
            space,
            self.out,
            trials=self.trials,
            minutes=self.minutes,
            eval_episodes=self.eval_episodes,
            console=console,
        )
        print(describe_sweep(found, space))
        print(self.out / "sweep.html")


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
      scene: name or path of a scene to try it in, or `stored` for the one in the agent's file; by
        default the one that it was trained in, as long as that has not changed.
      randomisation: domain randomisation by one preset, `off`, `tight` or `standard`; by default
        what it was trained with.
    """

    agent: tyro.conf.Positional[pathlib.Path]
    env: str | None = None
    physics: str | None = None
    epsilon: float = 0.1
    seed: int = 7
    max_steps: int = 1_000
    scene: str | None = None
    randomisation: str | None = None

    def load(self) -> Agent:
        check_device()
        check_epsilon(self.epsilon)
        if not 0 <= self.seed < 2**31:
            raise ValueError(f"seed must be from 0 to {2**31 - 1}, got {self.seed}")
        options = {"env": self.env, "physics": self.physics}
        given: dict[str, Any] = {name: x for name, x in options.items() if x is not None}
        if self.randomisation is not None:
            # The preset alone, without the ranges that the training changed.
            given |= dict.fromkeys(option_names(RandomisationConfig))
            given |= {"randomisation": self.randomisation, "growth_steps": 0}
        return load_agent(self.agent, max_steps=self.max_steps, scene=self.scene, **given)

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
            mesh=make_mesh(jax.local_device_count()),
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
    """Draw the curves of a run again, and write its report, also while it trains.

    Attributes:
      folder: a run folder.
    """

    folder: tyro.conf.Positional[pathlib.Path]

    def run(self, given: frozenset[str]) -> None:
        """Runs the command."""
        del given
        config = load_config(self.folder)
        seeds = seed_folders(self.folder, config)
        for path in plot_curves(seeds, into=self.folder):
            print(path)
        print(write_report(self.folder, config, seeds))


@dataclasses.dataclass(frozen=True)
class Compare:
    """Put runs side by side: success with 95 % intervals, time to a success rate, options.

    Attributes:
      runs: run folders; the others are compared with the first.
      out: a page to write, ending in `.html`, with the curves of all runs in one picture.
      json: print one JSON array.
    """

    runs: tyro.conf.Positional[tuple[pathlib.Path, ...]]
    out: pathlib.Path | None = None
    json: bool = False

    def run(self, given: frozenset[str]) -> None:
        """Runs the command."""
        del given
        results = [read_result(folder) for folder in self.runs]
        print(json.dumps(to_json(results)) if self.json else describe(results))
        if self.out is not None:
            write_comparison(results, self.out)
            print(self.out, file=sys.stderr if self.json else sys.stdout)


@dataclasses.dataclass(frozen=True)
class Agents:
    """List the agents that come with the package, or show the card of one.

    Attributes:
      agent: name of an agent whose card to show.
      json: print JSON: an array of all agents, or one object.
    """

    agent: tyro.conf.Positional[str | None] = None
    json: bool = False

    def run(self, given: frozenset[str]) -> None:
        """Runs the command."""
        del given
        if self.agent is not None:
            agent = read_shipped(self.agent)
            print(json.dumps(agent.to_json()) if self.json else agent.card.rstrip())
            return
        agents = read_zoo()
        if self.json:
            print(json.dumps([agent.to_json() for agent in agents]))
            return
        print(describe_zoo(agents))
        print("\nmjx-arm agents NAME shows its card; mjx-arm play NAME records a video.")


@dataclasses.dataclass(frozen=True)
class View(ViewOptions):
    """Watch an agent in the browser: its Q-values, what it sees; step, push the cube by hand.

    An agent of a run that still trains is loaded again as often as the run saves it.

    Attributes:
      subject: an agent, a run folder, or the name or path of a scene.
    """

    subject: tyro.conf.Positional[pathlib.Path]

    def run(self, given: frozenset[str]) -> None:
        """Runs the command."""
        del given
        check_device()
        view(self)


Command = Train | Eval | Play | Figures | Compare | Agents | View | Sweep
_COMMANDS: dict[str, type[Command]] = {
    "train": Train,
    "eval": Eval,
    "play": Play,
    "figures": Figures,
    "compare": Compare,
    "agents": Agents,
    "view": View,
    "sweep": Sweep,
}
_SUBJECTS = {
    "agent": "an agent's file or a run folder",
    "folder": "a run folder",
    "runs": "run folders",
    "subject": "an agent, a run folder or a scene",
}


def default_preset() -> str:
    """`gpu` on an accelerator, `fast` on a CPU."""
    check_device()
    return "fast" if jax.default_backend() == "cpu" else "gpu"


Trains = TypeVar("Trains", Train, Sweep)


def _start(kind: type[Trains], arguments: Sequence[str]) -> tuple[Trains, dict[str, str]]:
    """What a command line starts from: its preset or file, and its task and algorithm by name.

    These two decide which options there are.
    """
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
    return kind(options=options, preset=preset), chosen


def _parse(arguments: Sequence[str]) -> tuple[Command, frozenset[str]]:
    """The command of a command line, and the names of the options on it.

    Raises:
      ValueError: it is invalid.
    """
    if not arguments:
        raise ValueError(f"give a command: one of {', '.join(_COMMANDS)}; see --help")
    if not {"-h", "--help"}.isdisjoint(arguments):
        _help(arguments)
    check_name("command", arguments[0], _COMMANDS)
    kind = _COMMANDS[arguments[0]]
    if kind is Train:
        return _parse_train(Train, arguments[1:])
    if kind is Sweep:
        return _parse_train(Sweep, arguments[1:])
    known = _annotations(kind)
    subject = next(iter(known))
    values, others = read_arguments(arguments[1:], known | {subject: pathlib.Path})
    return kind(**{**values, **_subject(kind, subject, arguments[0], others)}), frozenset(values)


def _subject(kind: type[Command], name: str, command: str, given: Sequence[str]) -> dict[str, Any]:
    """The argument of a command that has no `--`, by its name; empty where it may be left out."""
    if not given and kind is not Agents:
        raise ValueError(f"{command} needs {name.upper()}, {_SUBJECTS[name]}")
    if kind is Compare:
        return {name: tuple(pathlib.Path(text) for text in given)}
    _check_none(given[1:])
    if not given:
        return {}
    return {name: given[0] if kind is Agents else pathlib.Path(given[0])}


def _join(arguments: Sequence[str]) -> None:
    """Meets the other processes of the run, before anything asks jax for its devices."""
    known = {name: x for name, x in _annotations(Train).items() if name in _PROCESSES}
    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    for name in known:
        first.add_argument(f"--{name.replace('_', '-')}", nargs="?", const="")
    texts = vars(first.parse_known_args(arguments)[0])
    own = [f"--{name.replace('_', '-')}={text}" for name, text in texts.items() if text is not None]
    join_processes(**read_arguments(own, known)[0])


def _parse_train(kind: type[Trains], arguments: Sequence[str]) -> tuple[Trains, frozenset[str]]:
    if kind is Train:
        _join(arguments)
    start, chosen = _start(kind, arguments)
    own = {name: x for name, x in _annotations(kind).items() if name != "options"}
    # Of the defaults, since the options of the start may fit the others on the command line alone.
    known = flat_annotations(set_train_options(TrainConfig(), _kinds_of(start.options) | chosen))
    values, others = read_arguments(arguments, own | known)
    _check_none(others)
    options = {name: value for name, value in values.items() if name not in own}
    rest = {name: value for name, value in values.items() if name in own}
    start = dataclasses.replace(start, **rest)
    return (
        dataclasses.replace(start, options=set_train_options(start.options, options)),
        frozenset(values),
    )


def _kinds_of(options: TrainConfig) -> dict[str, str]:
    return {"task": options.env.task, "algorithm": options.algorithm}


def _help_of(kind: type[Trains], arguments: Sequence[str]) -> Trains:
    """The command with the values that its help shows."""
    start, chosen = _start(kind, arguments)
    return dataclasses.replace(start, options=set_train_options(start.options, chosen))


def _annotations(kind: type) -> dict[str, Any]:
    return typing.get_type_hints(kind, include_extras=True)


def _check_none(others: Sequence[str]) -> None:
    if others:
        raise ValueError(f"unexpected argument {others[0]!r}: options start with --")


def _help(arguments: Sequence[str]) -> NoReturn:
    """Prints the help, which shows the values of the preset, and the options of the task."""
    train_ = Annotated[Train, tyro.conf.subcommand("train", default=_help_of(Train, arguments))]
    sweep_ = Annotated[Sweep, tyro.conf.subcommand("sweep", default=_help_of(Sweep, arguments))]
    commands: Any = train_ | Eval | Play | Figures | Compare | Agents | View | sweep_
    first = [name for name in arguments[:1] if name in _COMMANDS]
    tyro.cli(
        commands,
        args=[*first, "--help"],
        prog="mjx-arm",
        config=(
            tyro.conf.OmitArgPrefixes,
            tyro.conf.OmitSubcommandPrefixes,
            tyro.conf.AvoidSubcommands,
        ),
    )
    raise AssertionError("tyro ends the process")


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command line.

    Returns:
      The exit status: 2 for invalid input or a disk that does not take the output, 130 for a run
      that was interrupted.
    """
    arguments = sys.argv[1:] if arguments is None else arguments
    try:
        command, given = _parse(arguments)
        # Whatever JAX_NUMPY_RANK_PROMOTION says: it is meant for the user's own programs.
        with jax.numpy_rank_promotion("allow"):
            command.run(given)
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        print(f"error: {where}{' '.join(str(error.strerror or error).split())}", file=sys.stderr)
        return 2
    except jax.errors.JaxRuntimeError as error:
        if "RESOURCE_EXHAUSTED" in str(error):
            advice = "give a smaller --replay-size, --num-envs or batch size"
            print(f"error: the device has run out of memory: {advice}", file=sys.stderr)
        elif alone():
            raise
        else:
            print(f"error: {lost_sentence(error)}", file=sys.stderr)
        return 2
    except RunInterruptedError as stop:
        if is_writer():
            print(stop, file=sys.stderr)
        return 130
    return 0


def run(arguments: Sequence[str] | None = None) -> NoReturn:
    """Runs the command line as a process of its own, and ends it.

    Ctrl-C and what schedulers send end it at once, which damages no file; while a run trains, it
    saves first.
    """
    for number in stop_signals():
        signal.signal(number, _stop)
    for stream in (sys.stdout, sys.stderr):
        # A terminal or a log that cannot show a character does not end a run.
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    status = main(arguments)
    end_together(status)
    sys.exit(status)


def _stop(number: int, frame: FrameType | None) -> NoReturn:
    """Ends the process at once.

    A KeyboardInterrupt would be lost inside of a compilation, or leave one running that crashes
    when Python shuts down around it.
    """
    # Not by print, which the signal may have interrupted.
    if os.isatty(1):
        os.write(1, b"\x1b[?25h")  # the cursor, which a progress bar hides
    with contextlib.suppress(OSError):  # the terminal may be gone
        os.write(2, b"stopped; a run that has started continues with --resume and its folder\n")
    os._exit(128 + number)
