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
import time
import typing
from collections.abc import Callable, Iterator, Sequence
from types import FrameType
from typing import Annotated, Any, Literal, NoReturn, TypeVar

import jax
import tyro
from rich.console import Console

from mjx_arm.algos.exploration import check_epsilon
from mjx_arm.arguments import read_arguments
from mjx_arm.config import TrainConfig, set_train_options
from mjx_arm.deploy.camera import VideoCamera
from mjx_arm.deploy.dynamixel import DynamixelConfig, DynamixelRobot, read_config
from mjx_arm.deploy.guard import make_guard
from mjx_arm.deploy.log import Log, replay
from mjx_arm.deploy.loop import LoopConfig, describe_outcome, run_loop, stop_on_signals
from mjx_arm.deploy.robot import Robot
from mjx_arm.deploy.standin_robot import StandInRobot
from mjx_arm.deploy.standin_server import StandInProcess
from mjx_arm.devices import check_device
from mjx_arm.envs.randomisation import RandomisationConfig
from mjx_arm.export import check_path, export_policy, image_shape, write_policy
from mjx_arm.options import (
    Count,
    Positive,
    check_name,
    check_value,
    flat_annotations,
    flat_names,
    get_option,
    option_names,
)
from mjx_arm.policy import Policy
from mjx_arm.presets import PRESETS
from mjx_arm.report.figures import plot_curves
from mjx_arm.report.progress import make_console
from mjx_arm.report.run_page import write_report
from mjx_arm.report.video import check_video_path, draw_episode, record_episode, write_video
from mjx_arm.reproduce.command import reproduce
from mjx_arm.standin.episodes import Trace
from mjx_arm.standin.levels import find_level
from mjx_arm.standin.world import check_env
from mjx_arm.tools.compare import describe, read_result, to_json, write_comparison
from mjx_arm.tools.search_space import parse_space
from mjx_arm.tools.sweep import describe_sweep, sweep
from mjx_arm.tools.transfer import ITERATIONS, in_standin, sample_starts, summarise
from mjx_arm.tools.wandb_log import WandbLog, import_wandb
from mjx_arm.tools.zoo import describe_zoo, read_shipped, read_zoo
from mjx_arm.training.agent import STORED, Agent, differences, load_agent
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


def check_seed(seed: int) -> None:
    """Refuses what is no seed.

    Raises:
      ValueError: it is not from 0 to 2**31 - 1.
    """
    if not 0 <= seed < 2**31:
        raise ValueError(f"seed must be from 0 to {2**31 - 1}, got {seed}")


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
        check_seed(self.seed)
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


@dataclasses.dataclass(frozen=True)
class Reproduce:
    """Make one page with the tables and figures of James & Johns 2016, measured again.

    Every figure is measured into a file of its own in the folder. A figure that has its file is not
    measured again, so a command that was stopped continues when it is run again. Without `--runs`
    and `--shipped` agents A and B are trained first, which takes hours; the number is printed
    before. The long studies are trained only when `--only` names them.

    Attributes:
      out: folder of the page.
      runs: a folder of run folders, or a run folder, whose agents are shown.
      shipped: show the agents that come with the package where the runs have none.
      seeds: of each agent that is trained.
      quick: tiny trainings and few episodes, to prove in minutes that everything works.
      only: parts to measure: `agents`, `figure1`, `figure2`, `figure3`, `episodes`, `figure4`,
        `pixels`, `reward`, `paper`, `ablations`, `ablations-B`, `page` (the page alone), or the
        name of a file in `cells/`.
    """

    out: pathlib.Path = pathlib.Path("runs/reproduction")
    runs: pathlib.Path | None = None
    shipped: bool = False
    seeds: int = 1
    quick: bool = False
    only: tuple[str, ...] = ()

    def run(self, given: frozenset[str]) -> None:
        """Runs the command."""
        del given
        check_device()
        reproduce(
            self.out,
            runs=self.runs,
            shipped=self.shipped,
            quick=self.quick,
            only=self.only,
            seeds=self.seeds,
            console=make_console(),
        )


@dataclasses.dataclass(frozen=True)
class _Real:
    """What the commands that try an agent in the stand-in for reality have in common.

    Attributes:
      agent: an agent's file, or a run folder, of which the best agent is taken.
      level: how far the stand-in is from the simulator: `near`, `medium`, `far`, or `test`.
      env: environment, `A` or `B`; by default the one it was trained in.
      start: `home`, or `in_grasp` with the cube in the closed gripper.
      epsilon: share of random actions.
      seed: of starts and random actions.
      scene: name or path of a scene, or `stored` for the one in the agent's file; by default the
        one that it was trained in, as long as that has not changed.
    """

    agent: tyro.conf.Positional[pathlib.Path]
    level: str = "near"
    env: str | None = None
    start: str = "home"
    epsilon: float = 0.1
    seed: int = 7
    scene: str | None = None

    def load(self, max_steps: int = 1_000) -> Agent:
        check_device()
        check_epsilon(self.epsilon)
        check_seed(self.seed)
        find_level(self.level)
        given = {} if self.env is None else {"env": self.env}
        if self.start != "home":
            given["start"] = self.start
        agent = load_agent(self.agent, max_steps=max_steps, scene=self.scene, **given)
        check_env(agent.env)
        return agent


@dataclasses.dataclass(frozen=True)
class Transfer(_Real):
    """Try an agent in the stand-in for reality, and say how far it came.

    The stand-in is MuJoCo's C physics and MuJoCo's own OpenGL renderer, with fixed offsets by
    level: camera, colours, friction, masses, servo gain, delay. Processes share the episodes.

    Attributes:
      episodes: number of episodes.
      max_steps: iterations until an episode ends.
      shadows: render shadows of the lights that cast them.
      out: a video of the first episode, ending in `.mp4` or `.gif`.
      json: print one JSON object.
    """

    episodes: int = 100
    max_steps: int = ITERATIONS
    shadows: bool = True
    out: pathlib.Path | None = None
    json: bool = False

    def run(self, given: frozenset[str]) -> None:
        """Runs the command."""
        del given
        check_value("episodes", Count, self.episodes)
        if self.out is not None:
            check_video_path(self.out)
        agent = self.load(self.max_steps)
        done: list[bool] = []

        def on_episode(trace: Trace) -> None:
            done.append(trace.success)
            if len(done) % 10 == 0 or len(done) == self.episodes:
                found = f"{sum(done)} successes in {len(done)} of {self.episodes} episodes"
                print(found, file=sys.stderr, flush=True)

        began = time.monotonic()
        traces = in_standin(
            agent,
            find_level(self.level),
            sample_starts(agent.env, self.seed, self.episodes),
            epsilon=self.epsilon,
            iterations=self.max_steps,
            seed=self.seed,
            shadows=self.shadows,
            video=self.out,
            on_episode=on_episode,
        )
        report = {
            "agent": str(self.agent),
            "level": self.level,
            "env": agent.env.config.env,
            "scene": agent.env.config.scene_name,
            "start": self.start,
            "epsilon": self.epsilon,
            "seed": self.seed,
            "shadows": self.shadows,
            **dataclasses.asdict(summarise(traces, agent.env)),
            "seconds": round(time.monotonic() - began, 1),
        }
        if self.json:
            print(json.dumps(report))
            return
        for name, value in report.items():
            print(f"{name:<22} {value}")


@dataclasses.dataclass(frozen=True)
class Deploy(_Real):
    """Drive a robot by an agent, at a fixed rate, and log it.

    The robot is the stand-in, in a process of its own, or an arm of Dynamixel servos. Ctrl-C stops
    the arm.

    Attributes:
      robot: `standin` or `dynamixel`.
      rate: actions a second, 25 or 50. Training has 50.
      seconds: how long it runs at most.
      dry_run: look and think, and send nothing to the robot.
      watchdog: stop where the newest image is older than this, s.
      workspace: x y z of the lower corner of the box that the gripper stays in, then of the upper
        one, m.
      arm: a JSON file that describes the arm of Dynamixel servos.
      port: of a stand-in that runs already; by default one is started.
      log: file for the log; by default `deploy-` and the time.
      replay: a log to replay instead: its images are given to the agent again.
      json: print one JSON object.
    """

    robot: Literal["standin", "dynamixel"] = "standin"
    rate: Literal[25, 50] = 25
    seconds: Positive = 60.0
    dry_run: bool = False
    watchdog: Positive = 0.3
    workspace: tuple[float, float, float, float, float, float] | None = None
    arm: pathlib.Path | None = None
    port: int | None = None
    log: pathlib.Path | None = None
    replay: pathlib.Path | None = None
    json: bool = False

    def run(self, given: frozenset[str]) -> int:
        """Runs the command; the exit status is 2 after a fault, and 130 after Ctrl-C."""
        del given
        if self.robot == "dynamixel" and self.arm is None:
            raise ValueError("--robot dynamixel needs --arm FILE, which describes the arm")
        arm = None if self.arm is None else read_config(self.arm)
        agent = self.load()
        policy = Policy(export_policy(agent))
        if self.replay is not None:
            self._print(dataclasses.asdict(replay(self.replay, policy)))
            return 0
        config = LoopConfig(
            rate=float(self.rate),
            seconds=self.seconds,
            epsilon=self.epsilon,
            degrees=agent.env.config.degrees_per_action,
            watchdog=self.watchdog,
            dry_run=self.dry_run,
            seed=self.seed,
        )
        guard = make_guard(agent.env.scene, agent.env.arm, self.workspace)
        path = self.log or pathlib.Path(f"deploy-{time.strftime('%Y%m%d-%H%M%S')}.jsonl")
        header: dict[str, Any] = {"agent": str(self.agent), "robot": self.robot}
        header |= {
            "level": self.level,
            "options": dataclasses.asdict(config),
            "limits": guard.limits.tolist(),
        }
        with (
            stop_on_signals() as stop,
            self._connect(agent, arm) as (robot, until),
            Log(path, {**header, "workspace": guard.box.tolist()}) as log,
        ):
            outcome = run_loop(robot, policy, guard, config, log, stop=stop, until=until)
        self._print({"log": str(path), **describe_outcome(outcome)})
        if outcome.ending == "fault":
            print(f"error: {outcome.reason}", file=sys.stderr)
        return {"done": 0, "stopped": 130, "fault": 2}[outcome.ending]

    @contextlib.contextmanager
    def _connect(
        self, agent: Agent, arm: DynamixelConfig | None
    ) -> Iterator[tuple[Robot, Callable[[], bool] | None]]:
        """The robot, and what says that the task is done, if anything does."""
        with contextlib.ExitStack() as stack:
            if self.robot == "dynamixel":
                assert arm is not None
                camera = VideoCamera(arm.camera, agent.env.config.size)
                stack.callback(camera.close)
                yield stack.enter_context(DynamixelRobot(arm, camera.frame)), None
                return
            port = self.port
            if port is None:
                starts = sample_starts(agent.env, self.seed, 1)
                process = StandInProcess(agent.env, find_level(self.level), starts)
                port = stack.enter_context(process).port
            robot = stack.enter_context(StandInRobot(port))
            yield robot, lambda: bool(robot.measured("success"))

    def _print(self, report: dict[str, Any]) -> None:
        if self.json:
            print(json.dumps(report))
            return
        for name, value in report.items():
            print(f"{name:<22} {value}")


@dataclasses.dataclass(frozen=True)
class Export:
    """Write the policy of an agent for other programs: image in, Q-values and action out.

    Attributes:
      agent: an agent's file, or a run folder, of which the best agent is taken.
      format: `stablehlo`, which runs wherever jax and flatbuffers are, or `onnx`, which needs the
        environment that `make onnx` builds.
      out: the file.
    """

    agent: tyro.conf.Positional[pathlib.Path]
    format: Literal["stablehlo", "onnx"] = "stablehlo"
    out: pathlib.Path = pathlib.Path("policy.bin")

    def run(self, given: frozenset[str]) -> None:
        """Runs the command."""
        del given
        check_device()
        check_path(self.out)
        # ONNX has convolutions; ours are matrix products over patches on a CPU.
        options: dict[str, Any] = {"convolution": "nn.Conv"} if self.format == "onnx" else {}
        agent = load_agent(self.agent, scene=STORED, **options)
        write_policy(agent, self.out, self.format)
        print(f"{self.out}: image {list(image_shape(agent))}, {agent.env.num_actions} actions")


Command = (
    Train
    | Eval
    | Play
    | Figures
    | Compare
    | Agents
    | View
    | Sweep
    | Reproduce
    | Transfer
    | Deploy
    | Export
)
_COMMANDS: dict[str, type[Command]] = {
    "train": Train,
    "eval": Eval,
    "play": Play,
    "figures": Figures,
    "compare": Compare,
    "agents": Agents,
    "view": View,
    "sweep": Sweep,
    "reproduce": Reproduce,
    "transfer": Transfer,
    "deploy": Deploy,
    "export": Export,
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
    if kind is Reproduce:
        values, others = read_arguments(arguments[1:], known)
        _check_none(others)
        return Reproduce(**values), frozenset(values)
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
    commands: Any = (
        train_
        | Eval
        | Play
        | Figures
        | Compare
        | Agents
        | View
        | sweep_
        | Reproduce
        | Transfer
        | Deploy
        | Export
    )
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
      The exit status: 2 for invalid input, a disk that does not take the output or a robot that has
      failed, 130 for a run that was interrupted.
    """
    arguments = sys.argv[1:] if arguments is None else arguments
    try:
        command, given = _parse(arguments)
        # Whatever JAX_NUMPY_RANK_PROMOTION says: it is meant for the user's own programs.
        with jax.numpy_rank_promotion("allow"):
            return command.run(given) or 0
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
    except KeyboardInterrupt:
        return 130
    except RunInterruptedError as stop:
        if is_writer():
            print(stop, file=sys.stderr)
        return 130


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
