"""Train a robot arm from pixels by deep Q-learning, entirely on the device."""

from typing import TYPE_CHECKING, Any

from mjx_arm.config import TrainConfig, train_config
from mjx_arm.envs.auto_reset import AutoReset
from mjx_arm.envs.config import EnvConfig
from mjx_arm.envs.env import Env, make
from mjx_arm.envs.state import EnvState, Snapshot
from mjx_arm.envs.tasks import register
from mjx_arm.envs.tasks.base import Task, TaskConfig
from mjx_arm.presets import PRESETS
from mjx_arm.render import make_renderer, rgb, segmentation
from mjx_arm.scene import Scene, load_scene
from mjx_arm.training.agent import Agent, load_agent
from mjx_arm.training.loop import make_train, make_trainer

if TYPE_CHECKING:
    from mjx_arm.training.runner import resume, train

__all__ = [
    "PRESETS",
    "Agent",
    "AutoReset",
    "Env",
    "EnvConfig",
    "EnvState",
    "Scene",
    "Snapshot",
    "Task",
    "TaskConfig",
    "TrainConfig",
    "load_agent",
    "load_scene",
    "make",
    "make_renderer",
    "make_train",
    "make_trainer",
    "register",
    "resume",
    "rgb",
    "segmentation",
    "train",
    "train_config",
]

__version__ = "0.2.0"


def __getattr__(name: str) -> Any:
    """Imports `train` and `resume` when they are asked for: they need plots and TensorBoard."""
    if name in ("resume", "train"):
        from mjx_arm.training import runner

        return getattr(runner, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
