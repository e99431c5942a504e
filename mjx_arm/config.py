"""Options of the environment: frozen, validated when made."""

from __future__ import annotations

import dataclasses
from typing import Any

OBSERVATIONS = ("rgb", "rgbd", "segmentation", "state", "packed")
REWARDS = ("paper", "completion")
CUBE_MOVES = ("never", "on_success", "always")
STARTS = ("home", "in_grasp")
BACKENDS = ("auto", "mjx", "mjx-warp", "native")


@dataclasses.dataclass(frozen=True, kw_only=True)
class RewardConfig:
    """Constants of the two rewards. Where the paper names no unit, the unit is our choice.

    Attributes:
      kind: `"paper"` is Algorithm 1 of James & Johns 2016 to the letter; `"completion"` bounds
        what a step without success can pay, so that finishing outbids hovering (at discount 0.99
        the paper's hovering just below 30 cm is worth 130, its success 100).
      success: paid once on success, both kinds.
      distance_decay: per `distance_unit`; the paper's 0.25.
      distance_unit: m; the paper names none, ours is a decimetre.
      height_unit: m; the unit of the cube's height in the paper's `1 + height`.
      completion_reach: most that a step can pay without a grasp, `completion` only.
      completion_hold: paid for a grasp at height 0, `completion` only.
      completion_lift: paid on top in proportion to the height, reached just below success.
      scale: factor on the sum, both kinds.
    """

    kind: str = "paper"
    success: float = 100.0
    distance_decay: float = 0.25
    distance_unit: float = 0.1
    height_unit: float = 1.0
    completion_reach: float = 0.3
    completion_hold: float = 0.4
    completion_lift: float = 0.4
    scale: float = 1.0

    def __post_init__(self) -> None:
        """Raises ValueError for a value out of its domain."""
        _one_of("reward", self.kind, REWARDS)
        for name in ("distance_decay", "distance_unit", "height_unit", "scale"):
            _positive(f"reward {name}", getattr(self, name))


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
        for name in ("lift", "max_steps", "degrees_per_action"):
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


def _positive(name: str, value: float) -> None:
    if not value > 0:
        raise ValueError(f"{name} is {value}: give a number above 0")
