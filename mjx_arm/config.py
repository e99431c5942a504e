"""Options of a training run: nested, frozen, checked when made."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import Field

from mjx_arm.envs.config import EnvConfig, set_env_options
from mjx_arm.envs.tasks import find_task
from mjx_arm.options import (
    MOST,
    Count,
    CountOrZero,
    Discount,
    NotNegative,
    Positive,
    Share,
    check_name,
    check_value,
    from_json,
    options,
    set_options,
    to_json,
)

CONFIG_FORMAT = 2
# Time steps of an environment that the replay can hold, and steps of a run with its last chunk.
_MOST_SLOTS = 2**30
_MOST_STEPS = 2_000_000_000
_MOST_SEED = 2**31

Widths = tuple[Count, Count, Count]


@options
class NetworkConfig:
    """Options of the shipped Q-networks.

    James & Johns 2016 have three convolutions with max-pooling between them and two dense layers,
    and name no sizes: these are our choice, made on two CPU cores.

    Attributes:
      network: empty for the shipped networks, or `module:Class` of a Flax module
        `observations [B, ...] -> Q-values [B, A]`, which is made with `num_actions`.
      widths: channels of the three convolutions.
      kernels: edges of their kernels, pixels.
      strides: their strides, pixels.
      pool: edge of the max-pooling between them, pixels; 1 for none.
      hidden: units of each hidden dense layer.
      dense_layers: number of hidden dense layers.
      dueling: value and advantage streams (Wang et al. 2016).
      layer_norm: LayerNorm after each hidden dense layer.
      convolution: `patches` or `nn.Conv`; `auto` takes patches on a CPU, `nn.Conv` elsewhere.
    """

    network: str = ""
    widths: Widths = (16, 32, 32)
    kernels: Widths = (4, 3, 3)
    strides: Widths = (2, 1, 1)
    pool: Count = 2
    hidden: Count = 256
    dense_layers: Count = 1
    dueling: bool = True
    layer_norm: bool = False
    convolution: Literal["auto", "patches", "nn.Conv"] = "auto"


@options
class ReplayConfig:
    """Options of the replay.

    Attributes:
      storage: what the replay keeps of a frame: `states` (rendered again when sampled) or
        `pixels`.
      replay_size: transitions that the replay holds.
    """

    storage: Literal["states", "pixels"] = "states"
    replay_size: Count = 200_000


@options
class ExplorationConfig:
    """Options of epsilon-greedy exploration.

    Attributes:
      epsilon_start: epsilon at the beginning.
      epsilon_end: epsilon after annealing.
      epsilon_steps: environment steps over which epsilon falls linearly.
      epsilon_spread: environments have different shares of random actions, in equal ratios over a
        range of this factor squared (after Horgan et al. 2018); 1 gives all environments the same
        share. Shares above 1 are cut to 1. Where none is cut, the mean share is epsilon. With the
        defaults the mean share is 0.68 at the beginning, where epsilon is 1, and 0.1 at the end.
    """

    epsilon_start: Share = 1.0
    epsilon_end: Share = 0.1
    epsilon_steps: Count = 100_000
    epsilon_spread: Annotated[float, Field(ge=1)] = 4.0


@options
class AlgorithmConfig:
    """Options of an algorithm; an algorithm's own class derives from this one.

    Attributes:
      gamma: discount of one step.
      n_step: rewards summed before bootstrapping.
      learning_starts: environment steps before the first update.
    """

    gamma: Discount = 0.99
    n_step: Count = 3
    learning_starts: CountOrZero = 5_000


@options
class DQNConfig(AlgorithmConfig):
    """Options of deep Q-learning.

    Attributes:
      gamma: discount of one step.
      n_step: rewards summed before bootstrapping.
      learning_starts: environment steps before the first update.
      batch_size: transitions in one update.
      updates_per_step: updates after each step of all environments.
      learning_rate: of Adam.
      max_grad_norm: gradients are clipped to this global norm; 0 for never.
      double: double Q-learning (van Hasselt et al. 2015).
      huber: Huber loss; else half the squared error.
      polyak: share of the online parameters in each update of the target's; 0 for copies.
      target_period: updates between copies, where `polyak` is 0.
    """

    batch_size: Count = 64
    updates_per_step: Count = 1
    learning_rate: Positive = 3e-4
    max_grad_norm: NotNegative = 10.0
    double: bool = True
    huber: bool = True
    polyak: Share = 0.002
    target_period: Count = 1_000


@options
class DistillConfig(AlgorithmConfig):
    """Options of distillation: a student sees pixels, its teacher sees the simulator's state.

    The teacher learns by DQN from state features. The student regresses on the teacher's Q-values
    in states of the same replay. The student alone is judged and saved.

    Attributes:
      gamma: discount of one step.
      n_step: rewards summed before bootstrapping.
      learning_starts: environment steps before the teacher's first update.
      teacher_batch_size: transitions in one update of the teacher.
      teacher_updates_per_step: updates of the teacher after each step of all environments.
      teacher_hidden: units of each of the teacher's two layers.
      teacher_learning_rate: of the teacher's Adam.
      teacher_polyak: share of the online parameters in each update of its target's.
      teacher_double: the teacher learns by double Q-learning (van Hasselt et al. 2015).
      teacher_huber: the teacher's loss is Huber's; else half the squared error.
      teacher_dueling: the teacher has a value and an advantage stream (Wang et al. 2016).
      teacher_layer_norm: LayerNorm after each of the teacher's hidden layers.
      student_starts: environment steps before the student's first update.
      student_batch_size: images in one update of the student.
      student_updates_per_step: updates of the student after each step of all environments.
      student_learning_rate: of the student's Adam.
      student_decay_steps: environment steps, from the student's first update on, over which that
        rate falls by a cosine to a twentieth; 0: it stays.
      student_polyak: share of the newest parameters in each update of the averaged ones, which act
        and are judged.
      student_warm_up: images that the student learns from before it drives.
      student_share: share of the environments that the student drives, after that.
      student_temperature: of the softmax over advantages that the student imitates, in units of
        their standard deviation in the state.
    """

    n_step: Count = 5
    teacher_batch_size: Count = 512
    teacher_updates_per_step: Count = 1
    teacher_hidden: Count = 512
    teacher_learning_rate: Positive = 3e-4
    teacher_polyak: Share = 0.005
    teacher_double: bool = True
    teacher_huber: bool = True
    teacher_dueling: bool = True
    teacher_layer_norm: bool = True
    student_starts: CountOrZero = 800_000
    student_batch_size: Count = 64
    student_updates_per_step: Count = 3
    student_learning_rate: Positive = 1e-3
    student_decay_steps: CountOrZero = 0
    student_polyak: Share = 0.005
    student_warm_up: CountOrZero = 300_000
    student_share: Share = 0.5
    student_temperature: Positive = 0.5


_ALGORITHMS: dict[str, type[AlgorithmConfig]] = {"dqn": DQNConfig, "distill": DistillConfig}


def train_env_config(**values: Any) -> EnvConfig:
    """Options of an environment as training takes them: packed pixels, bounded rewards."""
    start = EnvConfig(observation="packed", reward="completion", reward_scale=0.2, max_steps=300)
    return set_env_options(start, values)


@options
class TrainConfig:
    """Options of a training run.

    The values are our choice, made on two CPU cores; the preset `paper` has those that James &
    Johns 2016 state.

    Attributes:
      algorithm: `dqn` or `distill`.
      seed: of everything random.
      num_seeds: agents trained side by side, with seeds from `seed` on.
      num_envs: environments that run side by side.
      total_steps: environment steps of the whole run.
      chunk_steps: environment steps in one compiled call, between two looks at it from outside.
      select_every: environment steps between two evaluations that select the best agent, on starts
        that training does not see; 0 for never.
      select_episodes: episodes of each.
      env: options of the environment.
      network: options of the network that sees the observations.
      replay: options of the replay.
      exploration: options of the exploration.
      algo: options of the algorithm.
    """

    algorithm: Literal["dqn", "distill"] = "dqn"
    seed: Annotated[int, Field(ge=0)] = 0
    num_seeds: Count = 1
    num_envs: Count = 64
    total_steps: Annotated[int, Field(ge=1, le=_MOST_STEPS)] = 5_000_000
    chunk_steps: Count = 8_192
    select_every: CountOrZero = 262_144
    select_episodes: Count = 64
    env: EnvConfig = dataclasses.field(default_factory=train_env_config)
    network: NetworkConfig = dataclasses.field(default_factory=NetworkConfig)
    replay: ReplayConfig = dataclasses.field(default_factory=ReplayConfig)
    exploration: ExplorationConfig = dataclasses.field(default_factory=ExplorationConfig)
    algo: AlgorithmConfig = dataclasses.field(default_factory=DQNConfig)

    def check(self) -> None:
        """Rejects options that do not fit together."""
        wanted = _ALGORITHMS[self.algorithm]
        if type(self.algo) is not wanted:
            raise ValueError(
                f"algo must be of type {wanted.__name__}, which the algorithm "
                f"{self.algorithm!r} has, got {type(self.algo).__name__}"
            )
        kinds = ("packed",) if self.algorithm == "distill" else ("packed", "state")
        if self.env.observation not in kinds:
            raise ValueError(
                f"observation must be one of {', '.join(kinds)} to train by "
                f"{self.algorithm!r}, got {self.env.observation!r}"
            )
        if self.seed > _MOST_SEED - self.num_seeds:
            raise ValueError(f"seed must be at most {_MOST_SEED - self.num_seeds}, got {self.seed}")
        if self.env.observation == "packed" and not self.network.network:
            self._check_edges()
        slots, size = self.replay_slots, self.replay.replay_size
        if slots <= self.algo.n_step:
            raise ValueError(
                "replay_size must be at least (n_step + 1) * num_envs = "
                f"{(self.algo.n_step + 1) * self.num_envs}, got {size}"
            )
        if slots > _MOST_SLOTS:
            raise ValueError(f"replay_size must be at most {_MOST_SLOTS} * num_envs, got {size}")
        for name in ("batch_size", "teacher_batch_size", "student_batch_size"):
            batch = getattr(self.algo, name, 0)
            if size < batch:
                raise ValueError(f"replay_size must be at least {name} = {batch}, got {size}")

    def _check_edges(self) -> None:
        """Rejects images of which the convolutions leave nothing."""
        network = self.network
        edge = min(self.env.size)
        for layer, stride in enumerate(network.strides):
            edge = -(-edge // stride)
            # No pooling after the last one.
            edge = edge // network.pool if layer < len(network.strides) - 1 else edge
        if edge < 1:
            raise ValueError(
                f"size must have more pixels: strides {network.strides} and pool {network.pool} "
                f"leave nothing of {self.env.size}"
            )

    @property
    def replay_slots(self) -> int:
        """Time steps that the replay holds, for each environment."""
        return self.replay.replay_size // self.num_envs

    @property
    def samples_per_step(self) -> float:
        """Transitions that learning samples for each environment step."""
        if isinstance(self.algo, DistillConfig):
            updates = self.algo.teacher_updates_per_step
            return self.algo.teacher_batch_size * updates / self.num_envs
        assert isinstance(self.algo, DQNConfig)
        return self.algo.batch_size * self.algo.updates_per_step / self.num_envs

    @property
    def chunk_length(self) -> int:
        """Steps of all environments in one compiled call."""
        return max(1, self.chunk_steps // self.num_envs)

    @property
    def num_chunks(self) -> int:
        """Compiled calls of the whole run, the last one whole."""
        return -(-self.total_steps // (self.chunk_length * self.num_envs))


def set_train_options(config: TrainConfig, values: Mapping[str, Any]) -> TrainConfig:
    """The same options with some changed, each named without its group.

    Args:
      config: the options.
      values: such as `{"env": "B", "num_envs": 32, "learning_rate": 1e-4}`. Another task or
        algorithm comes with its own options.

    Raises:
      ValueError: an unknown option, or a value that it does not take.
    """
    groups: dict[str, Any] = {}
    task = values.get("task", config.env.task)
    check_value("task", str, task)
    if task != config.env.task:
        groups["env"] = set_env_options(config.env, {"task": task})
    algorithm = values.get("algorithm", config.algorithm)
    check_value("algorithm", str, algorithm)
    if algorithm != config.algorithm:
        check_name("algorithm", algorithm, _ALGORITHMS)
        groups["algo"] = _ALGORITHMS[algorithm]()
    return set_options(config, values, groups)


def advice(config: TrainConfig) -> list[str]:
    """Sentences about options that are valid, but unlikely to be wanted."""
    said = []
    if config.chunk_length < 16:
        said.append(
            f"a chunk has {config.chunk_length} steps of {config.num_envs} environments, so that "
            f"most of the time goes to the pauses between chunks: give --chunk-steps "
            f"{256 * config.num_envs}"
        )
    algo = config.algo
    if isinstance(algo, DistillConfig) and config.total_steps <= algo.student_starts:
        said.append(
            f"the run ends after {config.total_steps:,} steps, and the agent that is saved learns "
            f"from step {algo.student_starts:,} on: give a lower --student-starts, or more "
            "--total-steps"
        )
    needed = max(config.env.max_steps // 4, 8 * config.algo.n_step)
    if config.replay_slots < needed:
        said.append(
            f"the replay holds {config.replay_slots} steps of each environment, less than a "
            f"quarter of an episode: give --replay-size {config.env.max_steps * config.num_envs}"
        )
    if config.env.observation == "state" and config.network.dense_layers != 1:
        said.append(
            "--dense-layers changes networks that see images; one of state features has two"
        )
    if config.samples_per_step < 0.25:
        said.append(
            f"training samples {config.samples_per_step:.2g} transitions for each environment "
            f"step; runs that learnt had 1 to 8: give a larger batch or more updates per step"
        )
    return said


def train_config(**values: Any) -> TrainConfig:
    """Options of a training run, each named without its group; see `set_train_options`."""
    return set_train_options(TrainConfig(), values)


def dump_config(config: TrainConfig) -> dict[str, Any]:
    """A configuration as a JSON object."""
    return {"format": CONFIG_FORMAT, **to_json(config)}


def parse_config(text: str, where: str) -> TrainConfig:
    """A configuration from the JSON that `dump_config` made.

    Args:
      text: JSON.
      where: the file, for errors.

    Raises:
      ValueError: it is not JSON, of another format, or has an option that is unknown or invalid.
    """
    try:
        values = json.loads(text)
    except json.JSONDecodeError as error:
        raise ValueError(f"{where} is not JSON: line {error.lineno}, {error.msg}") from None
    if not isinstance(values, dict):
        raise ValueError(f"{where} must hold one JSON object with options")
    version = values.pop("format", None)
    if version is None and "env" in values and isinstance(values["env"], str):
        raise ValueError(
            f"{where} was written by mjx_arm 0.1, whose runs and agents this version cannot read: "
            "train again, or install mjx_arm 0.1"
        )
    if version != CONFIG_FORMAT:
        raise ValueError(f"{where} has the format {version!r}; this version reads {CONFIG_FORMAT}")
    task = _text(values.get("env"), "task", "lift", where)
    algorithm = _text(values, "algorithm", "dqn", where)
    check_name(f"algorithm in {where}:", algorithm, _ALGORITHMS)
    env_values = values.pop("env", {})
    if isinstance(env_values, dict):  # what the file leaves out is as training has it
        env_values = to_json(train_env_config(task=task)) | env_values
    env = from_json(
        EnvConfig, env_values, f"{where}, 'env'", {"task_options": find_task(task).config}
    )
    parts = {
        "network": NetworkConfig,
        "replay": ReplayConfig,
        "exploration": ExplorationConfig,
        "algo": _ALGORITHMS[algorithm],
    }
    groups: dict[str, Any] = {
        name: from_json(cls, values.pop(name, {}), f"{where}, {name!r}")
        for name, cls in parts.items()
    }
    for name in values:
        check_name(
            f"option in {where}:", name, [field.name for field in dataclasses.fields(TrainConfig)]
        )
    try:
        return TrainConfig(env=env, **groups, **values)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from None


def _text(values: Any, name: str, default: str, where: str) -> str:
    value = values.get(name, default) if isinstance(values, dict) else default
    if not isinstance(value, str):
        raise ValueError(f"{where}: {name} must be text, got {value!r}")
    return value


__all__ = [
    "CONFIG_FORMAT",
    "MOST",
    "AlgorithmConfig",
    "DQNConfig",
    "DistillConfig",
    "ExplorationConfig",
    "NetworkConfig",
    "ReplayConfig",
    "TrainConfig",
    "dump_config",
    "parse_config",
    "set_train_options",
    "train_config",
]
