"""Options of the environment and of a training run: frozen, validated when made."""

from __future__ import annotations

import dataclasses
from typing import Any

from mjx_arm.physics import BACKENDS

OBSERVATIONS = ("rgb", "rgbd", "segmentation", "state", "packed")
REWARDS = ("paper", "completion", "progress")
CUBE_MOVES = ("never", "on_success", "always")
STARTS = ("home", "in_grasp")


@dataclasses.dataclass(frozen=True, kw_only=True)
class RewardConfig:
    """Constants of the rewards. Where the paper names no unit, the unit is our choice.

    Attributes:
      kind: `"paper"` is Algorithm 1 of James & Johns 2016 to the letter: `success` once, else
        `1 + height` while grasped, else `exp(-0.25 * distance)`. `"completion"` keeps the shape but
        bounds what a step without success can pay, so that finishing outbids hovering (at discount
        0.99 the paper's hovering just below 30 cm is worth 130, its success 100). `"progress"` pays
        for success alone, and on top the gain of a potential (Ng et al. 1999), which changes no
        optimal policy: the potential being about what a state is worth, Q-values become small, and
        a step in the wrong direction is no longer 1 % of one.
      success: paid once on success, all kinds.
      discount: of the potential, `progress` only; that of the agent.
      progress_steps_per_metre: steps that the potential counts for a metre of the gripper.
      progress_grasp_steps: and for the grasp.
      distance_decay: per `distance_unit`, of the paper's reward; its 0.25.
      distance_unit: m; the paper names none, ours is a decimetre.
      height_unit: m; the unit of the cube's height in the paper's `1 + height`.
      completion_decay: per `distance_unit`, `completion` only.
      completion_reach: most that a step can pay without a grasp, `completion` only.
      completion_hold: paid for a grasp at height 0, `completion` only.
      completion_lift: most that is paid on top for the height, with its square root: in proportion
        to it, the first degree of a lift is worth 2 % of a Q-value, and is not found.
      scale: factor on the sum, all kinds.
    """

    kind: str = "paper"
    success: float = 100.0
    discount: float = 0.99
    progress_steps_per_metre: float = 160.0
    progress_grasp_steps: float = 20.0
    distance_decay: float = 0.25
    distance_unit: float = 0.1
    height_unit: float = 1.0
    completion_decay: float = 1.0
    completion_reach: float = 0.2
    completion_hold: float = 0.25
    completion_lift: float = 0.5
    scale: float = 1.0

    def __post_init__(self) -> None:
        """Raises ValueError for a value out of its domain."""
        _one_of("reward", self.kind, REWARDS)
        for name in ("distance_decay", "completion_decay", "distance_unit", "height_unit", "scale"):
            _positive(f"reward {name}", getattr(self, name))
        if not 0.0 < self.discount <= 1.0:
            raise ValueError(f"reward discount is {self.discount}: give more than 0, at most 1")


@dataclasses.dataclass(frozen=True, kw_only=True)
class EnvConfig:
    """Options of `mjx_arm.make`.

    Attributes:
      scene: a scene's name, or the path of an MJCF file with the task's names.
      physics: `"auto"` (native on CPU, mjx elsewhere), `"mjx"`, `"mjx-warp"` or `"native"`.
      observation: `"rgb"`, `"rgbd"`, `"segmentation"`, `"state"`, or `"packed"` (colour and geom
        id in one uint32 a pixel, what the training loop stores).
      size: height and width of the image, pixels.
      camera: a fixed camera of the scene.
      shadows: hard shadows in the image.
      reward: constants of the reward.
      joint_noise: each joint starts uniformly within this of home, degrees.
      cube_moves: when the cube gets a new place in its rectangle: `"never"`, `"on_success"` (as
        the paper trains: it outlives failed episodes) or `"always"` (for evaluation).
      start: `"home"`, or `"in_grasp"` with the cube held by the shut gripper.
      lift: height that the cube must be lifted to, m.
      max_steps: iterations until an episode is truncated.
      degrees_per_action: how far one action turns a joint, degrees.
    """

    scene: str = "arm_cube"
    physics: str = "auto"
    observation: str = "rgb"
    size: tuple[int, int] = (64, 64)
    camera: str = "front"
    shadows: bool = False
    reward: RewardConfig = dataclasses.field(default_factory=RewardConfig)
    joint_noise: float = 0.0
    cube_moves: str = "never"
    start: str = "home"
    lift: float = 0.3
    max_steps: int = 1000
    degrees_per_action: float = 1.0

    def __post_init__(self) -> None:
        """Raises ValueError for a value out of its domain."""
        _one_of("physics", self.physics, BACKENDS)
        _one_of("observation", self.observation, OBSERVATIONS)
        _one_of("cube_moves", self.cube_moves, CUBE_MOVES)
        _one_of("start", self.start, STARTS)
        _whole("max_steps", self.max_steps, at_least=1)
        for name in ("lift", "degrees_per_action"):
            _positive(name, getattr(self, name))
        if not 0.0 <= self.joint_noise <= 45.0:
            raise ValueError(f"joint_noise is {self.joint_noise}: give 0 to 45 degrees")
        if min(self.size) < 1:
            raise ValueError(
                f"size is {self.size}: give height and width in pixels, each at least 1"
            )


# What sets the paper's two environments apart (section 4.2).
ENVIRONMENTS: dict[str, dict[str, Any]] = {
    "A": {"joint_noise": 0.0, "cube_moves": "never"},
    "B": {"joint_noise": 20.0, "cube_moves": "on_success"},
}


def env_config(name: str, **options: Any) -> EnvConfig:
    """Configuration of environment `"A"` or `"B"` with some options changed.

    Args:
      name: `"A"` (everything constant) or `"B"` (joints within 20 degrees of home, cube anywhere in
        its rectangle).
      **options: fields of `EnvConfig`; `reward` may also be the name of a reward.

    Raises:
      ValueError: unknown environment or option, or a value out of its domain.
    """
    _one_of("environment", name, tuple(ENVIRONMENTS))
    known = [field.name for field in dataclasses.fields(EnvConfig)]
    for option in options:
        _one_of("option", option, tuple(known))
    if isinstance(options.get("reward"), str):
        options["reward"] = RewardConfig(kind=options["reward"])
    if "size" in options:
        options["size"] = tuple(options["size"])
    return EnvConfig(**{**ENVIRONMENTS[name], **options})


def _one_of(what: str, value: Any, known: tuple[str, ...]) -> None:
    if value not in known:
        raise ValueError(f"unknown {what} {value!r}: give one of {', '.join(known)}")


def _whole(name: str, value: int, at_least: int) -> None:
    if value < at_least:
        raise ValueError(f"{name} is {value}: give at least {at_least}")
    if value > _MOST:
        raise ValueError(f"{name} is {value}: give at most {_MOST}")


def _positive(name: str, value: float) -> None:
    if not value > 0:
        raise ValueError(f"{name} is {value}: give a number above 0")


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """Options of a training run.

    The values are our choice, made on two CPU cores; James & Johns 2016 have others where
    they state any (Adam at 6e-6, a replay of 500,000, squared error, episodes of 1,000).

    Attributes:
      env: environment, `"A"` or `"B"`.
      physics: `"auto"`, `"mjx"`, `"mjx-warp"` or `"native"`.
      scene: a scene's name, or the path of an MJCF file with the task's names.
      observation: what the network sees: `"packed"` pixels, or `"state"` features.
      size: height and width of the image, pixels.
      shadows: hard shadows in the image.
      reward: `"progress"`, `"completion"` or `"paper"`; see `RewardConfig`.
      reward_scale: factor on every reward.
      max_steps: iterations until a training episode is truncated. The paper's 1,000, which
        evaluation keeps, spend most of the time on cubes that have been knocked away.
      seed: of everything random.
      num_seeds: agents trained side by side, with seeds from `seed` on.
      num_envs: environments that run side by side.
      total_steps: environment steps of the whole run.
      storage: what the replay keeps of a frame: `"states"` (rendered again when sampled) or
        `"pixels"`.
      replay_size: transitions that the replay holds.
      batch_size: transitions in one update.
      updates_per_step: updates after each step of all environments.
      learning_starts: environment steps before the first update.
      n_step: rewards summed before bootstrapping.
      gamma: discount of one step.
      learning_rate: of Adam.
      max_grad_norm: gradients are clipped to this global norm; 0 for never.
      double: double Q-learning.
      dueling: value and advantage streams.
      huber: Huber loss, else squared.
      polyak: share of the online parameters in each update of the target's; 0 for copies.
      target_period: updates between copies, where `polyak` is 0.
      epsilon_start: share of random actions at the beginning.
      epsilon_end: and after annealing.
      epsilon_steps: environment steps over which it falls linearly.
      epsilon_spread: environments have different shares, in equal ratios from that divided by this
        to that times this (Horgan et al. 2018): the one end finishes what it begins, the other
        sees what comes after mistakes. 1 for all alike.
      widths: channels of the three convolutions.
      kernels: edges of their kernels, pixels.
      strides: their strides, pixels.
      pool: edge of the max-pooling between them, pixels; 1 for none.
      hidden: units of the first dense layer.
      chunk_steps: environment steps in one compiled call, between two looks at it from outside.
      select_every: environment steps between two evaluations that select the best agent, on starts
        that training does not see; 0 for never.
      select_episodes: episodes of each.
    """

    env: str = "A"
    physics: str = "auto"
    scene: str = "arm_cube"
    observation: str = "packed"
    size: tuple[int, int] = (64, 64)
    shadows: bool = False
    reward: str = "progress"
    reward_scale: float = 0.1
    max_steps: int = 300
    seed: int = 0
    num_seeds: int = 1
    num_envs: int = 64
    total_steps: int = 5_000_000
    storage: str = "states"
    replay_size: int = 200_000
    batch_size: int = 64
    updates_per_step: int = 1
    learning_starts: int = 5_000
    n_step: int = 3
    gamma: float = 0.99
    learning_rate: float = 3e-4
    max_grad_norm: float = 10.0
    double: bool = True
    dueling: bool = True
    huber: bool = True
    polyak: float = 0.002
    target_period: int = 1_000
    epsilon_start: float = 1.0
    epsilon_end: float = 0.1
    epsilon_steps: int = 100_000
    epsilon_spread: float = 4.0
    widths: tuple[int, int, int] = (16, 32, 32)
    kernels: tuple[int, int, int] = (4, 3, 3)
    strides: tuple[int, int, int] = (2, 1, 1)
    pool: int = 2
    hidden: int = 256
    chunk_steps: int = 8_192
    select_every: int = 262_144
    select_episodes: int = 64

    def __post_init__(self) -> None:
        """Raises ValueError for a value out of its domain."""
        _one_of("environment", self.env, tuple(ENVIRONMENTS))
        _one_of("physics", self.physics, BACKENDS)
        _one_of("observation", self.observation, ("packed", "state"))
        _one_of("reward", self.reward, REWARDS)
        _one_of("storage", self.storage, ("states", "pixels"))
        for name in _COUNTS:
            _whole(name, getattr(self, name), at_least=1)
        _whole("learning_starts", self.learning_starts, at_least=0)
        if not 0 <= self.seed <= _MOST_SEED - self.num_seeds:
            raise ValueError(f"seed is {self.seed}: give 0 to {_MOST_SEED - self.num_seeds}")
        if self.total_steps > _MOST_STEPS:
            raise ValueError(f"total_steps is {self.total_steps}: give at most {_MOST_STEPS}")
        for name in ("widths", "kernels", "strides", "size"):
            if min(getattr(self, name)) < 1:
                raise ValueError(
                    f"{name} is {getattr(self, name)}: give whole numbers, each at least 1"
                )
        if self.observation == "packed" and self._smallest_edge() < 1:
            raise ValueError(
                f"size is {self.size}: strides and pooling leave nothing of it, give more pixels"
            )
        if self.select_every < 0:
            raise ValueError(f"select_every is {self.select_every}: give 0 or more")
        for name in ("learning_rate", "reward_scale", "gamma"):
            _positive(name, getattr(self, name))
        for name in ("epsilon_start", "epsilon_end", "gamma", "polyak"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"{name} is {getattr(self, name)}: give 0 to 1")
        if self.epsilon_spread < 1.0:
            raise ValueError(f"epsilon_spread is {self.epsilon_spread}: give at least 1")
        if self.replay_slots <= self.n_step:
            raise ValueError(
                f"replay_size is {self.replay_size}: give at least (n_step + 1) * num_envs = "
                f"{(self.n_step + 1) * self.num_envs}"
            )
        if self.replay_slots > _MOST_SLOTS:
            raise ValueError(
                f"replay_size is {self.replay_size}: give at most {_MOST_SLOTS} * num_envs"
            )
        if self.replay_size < self.batch_size:
            raise ValueError(
                f"replay_size is {self.replay_size}: give at least batch_size = {self.batch_size}"
            )

    def _smallest_edge(self) -> int:
        """Of what the last convolution gives, pixels."""
        edge = min(self.size)
        for layer, stride in enumerate(self.strides):
            edge = -(-edge // stride)
            # No pooling after the last one.
            edge = edge // self.pool if layer < len(self.strides) - 1 else edge
        return edge

    @property
    def replay_slots(self) -> int:
        """Time steps that the replay holds, for each environment."""
        return self.replay_size // self.num_envs

    @property
    def chunk_length(self) -> int:
        """Steps of all environments in one compiled call."""
        return max(1, self.chunk_steps // self.num_envs)

    @property
    def num_chunks(self) -> int:
        """Compiled calls of the whole run, the last one whole."""
        return -(-self.total_steps // (self.chunk_length * self.num_envs))

    def env_config(self) -> EnvConfig:
        """Options of the environment that this run trains in."""
        return env_config(
            self.env,
            physics=self.physics,
            scene=self.scene,
            observation=self.observation,
            size=self.size,
            shadows=self.shadows,
            reward=RewardConfig(kind=self.reward, scale=self.reward_scale, discount=self.gamma),
            max_steps=self.max_steps,
        )


# All counts are 32 bits wide; steps with room for a last chunk.
_MOST = 2**31 - 1
_MOST_SLOTS = 2**30
_MOST_STEPS = 2_000_000_000
_MOST_SEED = 2**31

_COUNTS = (
    "num_seeds",
    "num_envs",
    "total_steps",
    "replay_size",
    "batch_size",
    "updates_per_step",
    "n_step",
    "target_period",
    "epsilon_steps",
    "hidden",
    "pool",
    "chunk_steps",
    "max_steps",
    "select_episodes",
)

# Starting points of the command line. `fast` reached 93 % in environment A for two seeds of two
# (benchmarks/results/success_A.json); `smoke` shows in minutes that everything works; `paper` has
# every value that James & Johns 2016 state, and where they state none (batch, target period, number
# of environments) ours.
PRESETS = {
    "fast": TrainConfig(),
    "smoke": TrainConfig(
        total_steps=32_768,
        replay_size=20_000,
        learning_starts=1_000,
        epsilon_steps=20_000,
        batch_size=32,
        chunk_steps=4_096,
        select_every=16_384,
        select_episodes=16,
    ),
    "paper": TrainConfig(
        reward="paper",
        reward_scale=1.0,
        max_steps=1_000,
        total_steps=10_000_000,
        replay_size=500_000,
        n_step=1,
        learning_rate=6e-6,
        max_grad_norm=0.0,
        double=False,
        dueling=False,
        huber=False,
        polyak=0.0,
        epsilon_steps=1_000_000,
        epsilon_spread=1.0,
    ),
}
