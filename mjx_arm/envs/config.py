"""Options of an environment."""

from __future__ import annotations

import dataclasses
from typing import Any, Literal

from mjx_arm.envs.randomisation import RandomisationConfig
from mjx_arm.envs.tasks import TaskConfig, find_task
from mjx_arm.options import (
    Count,
    NotNegative,
    Positive,
    Size,
    check_value,
    options,
    set_options,
)

Physics = Literal["auto", "native", "mjx", "mjx-warp"]
ObservationKind = Literal["rgb", "rgbd", "segmentation", "state", "packed"]

# What sets the paper's two environments apart (section 4.2).
_JOINT_NOISE = {"A": 0.0, "B": 20.0}
_MOST_NOISE = 45.0
_PLACEMENT = {"A": "fixed", "B": "after_success"}


@options
class EnvConfig:
    """Options of `mjx_arm.make`.

    Attributes:
      env: `A` (everything constant) or `B` (joints and objects varied).
      task: a registered task: `lift`, `reach` or `push`, or a user's own.
      scene: a scene's name, or the path of an MJCF file; empty for the task's own scene.
      physics: `auto` (native on CPU, mjx on other devices), `native`, `mjx` or `mjx-warp`.
      observation: `rgb`, `rgbd`, `segmentation`, `state` (features), or `packed` (colour and geom
        id in one uint32 a pixel, what the training loop stores).
      size: height and width of the image, pixels.
      camera: a camera of the scene, or several, whose images are stacked: `[C, H, W]` pixels.
      shadows: hard shadows in the image.
      samples: rays through each pixel, whose mean smooths the edges: 1, 4 or 16.
      reward: a reward of the task, or `module:function`; empty for the task's first one.
      reward_scale: factor on every term of the reward.
      joint_noise: each joint starts uniformly within this of home, degrees; None for 0 in A and
        20 in B. Slides start within that many millimetres.
      joint_noise_scale: factor on `joint_noise`. An agent that trains with more than 1 has seen a
        wider range of poses than it is judged from.
      placement: when the task's objects get new places: `fixed` (never), `after_success` (as the
        paper trains: a place outlives failed episodes) or `always`; None for `fixed` in A and
        `after_success` in B.
      max_steps: iterations until an episode is truncated.
      degrees_per_action: how far one action turns a hinge, degrees.
      millimetres_per_action: how far one action moves a slide, mm.
      task_options: options of the task; of the class that the task is registered with.
      randomise: options of domain randomisation.
    """

    env: Literal["A", "B"] = "A"
    task: str = "lift"
    scene: str = ""
    physics: Physics = "auto"
    observation: ObservationKind = "rgb"
    size: Size = (64, 64)
    camera: str | tuple[str, ...] = "front"
    shadows: bool = False
    samples: Literal[1, 4, 16] = 1
    reward: str = ""
    reward_scale: Positive = 1.0
    joint_noise: NotNegative | None = None
    joint_noise_scale: Positive = 1.0
    placement: Literal["fixed", "after_success", "always"] | None = None
    max_steps: Count = 1000
    degrees_per_action: Positive = 1.0
    millimetres_per_action: Positive = 5.0
    task_options: TaskConfig = dataclasses.field(default_factory=find_task("lift").config)
    randomise: RandomisationConfig = dataclasses.field(default_factory=RandomisationConfig)

    def check(self) -> None:
        """Rejects options that do not fit together."""
        entry = find_task(self.task)
        if type(self.task_options) is not entry.config:
            raise ValueError(
                f"task_options must be of type {entry.config.__name__}, which the task "
                f"{self.task!r} has, got {type(self.task_options).__name__}"
            )
        if not self.cameras:
            raise ValueError("camera must name at least one camera, got ()")
        if self.noise_degrees > _MOST_NOISE:
            raise ValueError(
                f"joint_noise * joint_noise_scale must be at most {_MOST_NOISE:g} degrees, "
                f"got {self.noise_degrees:g}"
            )

    @property
    def scene_name(self) -> str:
        """The scene's name or path."""
        return self.scene or find_task(self.task).scene

    @property
    def noise_degrees(self) -> float:
        """How far each joint starts from home at most, degrees."""
        noise = _JOINT_NOISE[self.env] if self.joint_noise is None else self.joint_noise
        return noise * self.joint_noise_scale

    @property
    def placed(self) -> str:
        """`placement`, or what it is in this environment."""
        return _PLACEMENT[self.env] if self.placement is None else self.placement

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras."""
        return (self.camera,) if isinstance(self.camera, str) else self.camera


def env_config(env: str = "A", **values: Any) -> EnvConfig:
    """Options of environment `"A"` or `"B"` with some changed.

    Args:
      env: `"A"` or `"B"`.
      **values: fields of `EnvConfig` and of the task's own options.

    Raises:
      ValueError: an unknown option, or a value that it does not take.
    """
    return set_env_options(EnvConfig(), {"env": env, **values})


def set_env_options(config: EnvConfig, values: dict[str, Any]) -> EnvConfig:
    """The same options with some changed; another task comes with its own options."""
    task = values.get("task", config.task)
    check_value("task", str, task)
    if task != config.task:
        config = dataclasses.replace(config, task=task, task_options=find_task(task).config())
    return set_options(config, values)
