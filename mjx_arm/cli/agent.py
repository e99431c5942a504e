"""The commands that try or write an agent: `eval`, `play` and `export`."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import pathlib
from collections.abc import Mapping
from typing import Any, Literal

import jax
import tyro

from mjx_arm.algos.exploration import check_epsilon
from mjx_arm.devices import check_device
from mjx_arm.envs.randomisation import RandomisationConfig
from mjx_arm.export import check_path, image_shape, write_policy
from mjx_arm.options import option_names
from mjx_arm.report.progress import make_console, phase
from mjx_arm.report.video import check_video_path, record_episode, render_episode, write_video
from mjx_arm.training.agent import STORED, Agent, differences, load_agent
from mjx_arm.training.evaluate import evaluate
from mjx_arm.training.loop import EVALUATION, role_key
from mjx_arm.training.mesh import make_mesh


def check_seed(seed: int) -> None:
    """Rejects what is no seed.

    Raises:
      ValueError: it is not from 0 to 2**31 - 1.
    """
    if not 0 <= seed < 2**31:
        raise ValueError(f"seed must be from 0 to {2**31 - 1}, got {seed}")


def print_report(report: Mapping[str, Any]) -> None:
    """Prints names and values in two columns."""
    for name, value in report.items():
        print(f"{name:<22} {value}")


@dataclasses.dataclass(frozen=True)
class AgentOptions:
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
        """The agent, in the environment that the options name.

        Raises:
          ValueError: an option has a value that is not allowed, or the agent cannot be read.
        """
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
        """Key of the episodes."""
        return role_key(self.seed, EVALUATION)


@dataclasses.dataclass(frozen=True)
class Eval(AgentOptions):
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
        what = f"evaluating: {self.episodes} episodes in {agent.config.env.env}"
        # Standard output with nothing but JSON can be piped.
        said = contextlib.nullcontext() if self.json else phase(make_console(), what)
        with said:
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
        differs = differences(agent.trained_env, agent.config.env)
        if self.json:
            print(json.dumps(report | {"differs": differs}))
            return
        print_report(report | report.pop("metrics"))
        for name, (trained, judged) in differs.items():
            print(f"trained with {name} = {trained}, judged with {judged}")


@dataclasses.dataclass(frozen=True)
class Play(AgentOptions):
    """Record one episode of an agent as a video.

    Attributes:
      out: the video, ending in `.mp4` or `.gif`.
    """

    out: pathlib.Path = pathlib.Path("video.mp4")

    def run(self, given: frozenset[str]) -> None:
        """Runs the command."""
        del given
        check_video_path(self.out)
        agent, console = self.load(), make_console()
        with phase(console, f"an episode in {agent.config.env.env}", "compiling comes first"):
            episode = record_episode(
                agent.env, agent.apply, agent.params, epsilon=self.epsilon, key=self.key()
            )
        with phase(console, "rendering the video"):
            write_video(self.out, render_episode(agent.env, episode))
        print(f"{self.out}: {len(episode)} frames, success: {episode.success}")


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
