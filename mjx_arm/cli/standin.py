"""The commands beyond the simulator: `transfer` and `deploy`."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import pathlib
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any, Literal

import tyro

from mjx_arm.algos.exploration import check_epsilon
from mjx_arm.cli.agent import check_seed, print_report
from mjx_arm.deploy.camera import VideoCamera
from mjx_arm.deploy.dynamixel import DynamixelConfig, DynamixelRobot, read_config
from mjx_arm.deploy.guard import Guard, make_guard
from mjx_arm.deploy.log import Log, replay
from mjx_arm.deploy.loop import LoopConfig, describe_outcome, run_loop, stop_on_signals
from mjx_arm.deploy.robot import Robot
from mjx_arm.deploy.standin_robot import StandInRobot
from mjx_arm.deploy.standin_server import StandInProcess
from mjx_arm.devices import check_device
from mjx_arm.export import export_policy
from mjx_arm.options import Count, Positive, check_value
from mjx_arm.policy import Policy
from mjx_arm.report.video import check_video_path
from mjx_arm.standin.episodes import Trace
from mjx_arm.standin.levels import find_level
from mjx_arm.standin.world import check_env
from mjx_arm.tools.transfer import ITERATIONS, in_standin, sample_starts, summarise
from mjx_arm.training.agent import Agent, load_agent


@dataclasses.dataclass(frozen=True)
class StandInOptions:
    """What the commands that try an agent in the stand-in for reality have in common.

    Attributes:
      agent: an agent's file, or a run folder, of which the best agent is taken.
      level: how far the stand-in is from the simulator: `test`, or one of `near`, `medium` and
        `far`, at which an agent is judged three times at most.
      env: environment, `A` or `B`; by default the one it was trained in.
      start: `home`, or `in_grasp` with the cube in the closed gripper.
      epsilon: share of random actions.
      seed: of starts and random actions.
      scene: name or path of a scene, or `stored` for the one in the agent's file; by default the
        one that it was trained in, as long as that has not changed.
    """

    agent: tyro.conf.Positional[pathlib.Path]
    level: str = "test"
    env: str | None = None
    start: str = "home"
    epsilon: float = 0.1
    seed: int = 7
    scene: str | None = None

    def load(self, max_steps: int = 1_000) -> Agent:
        """The agent, in an environment that the stand-in can be.

        Raises:
          ValueError: an option has a value that is not allowed, or the agent cannot be read.
        """
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
class Transfer(StandInOptions):
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
        else:
            print_report(report)


@dataclasses.dataclass(frozen=True)
class Deploy(StandInOptions):
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
            self._connect(agent, arm, guard) as (robot, until),
            Log(path, {**header, "workspace": guard.box.tolist()}) as log,
        ):
            outcome = run_loop(robot, policy, guard, config, log, stop=stop, until=until)
        self._print({"log": str(path), **describe_outcome(outcome)})
        if outcome.ending == "fault":
            print(f"error: {outcome.reason}", file=sys.stderr)
        return {"done": 0, "stopped": 130, "fault": 2}[outcome.ending]

    @contextlib.contextmanager
    def _connect(
        self, agent: Agent, arm: DynamixelConfig | None, guard: Guard
    ) -> Iterator[tuple[Robot, Callable[[], bool] | None]]:
        """The robot, and what says that the task is done, if anything does."""
        with contextlib.ExitStack() as stack:
            if self.robot == "dynamixel":
                assert arm is not None
                camera = VideoCamera(arm.camera, agent.env.config.size)
                stack.callback(camera.close)
                yield stack.enter_context(DynamixelRobot(arm, camera.frame, guard.limits)), None
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
        else:
            print_report(report)
