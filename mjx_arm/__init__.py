"""Train a robot arm from pixels by deep Q-learning, entirely on the device."""

from mjx_arm.agent import Agent, load_agent
from mjx_arm.auto_reset import AutoReset
from mjx_arm.config import PRESETS, EnvConfig, RewardConfig, TrainConfig
from mjx_arm.env import Env, EnvState, make
from mjx_arm.loop import make_train
from mjx_arm.render import make_renderer, rgb, segmentation
from mjx_arm.scene import Scene, load_scene

__all__ = [
    "PRESETS",
    "Agent",
    "AutoReset",
    "Env",
    "EnvConfig",
    "EnvState",
    "RewardConfig",
    "Scene",
    "TrainConfig",
    "load_agent",
    "load_scene",
    "make",
    "make_renderer",
    "make_train",
    "rgb",
    "segmentation",
]

__version__ = "0.1.0"
