"""Train a robot arm from pixels by deep Q-learning, entirely on the device."""

from mjx_arm.auto_reset import AutoReset
from mjx_arm.config import EnvConfig, RewardConfig
from mjx_arm.env import Env, EnvState, make
from mjx_arm.render import Appearance, default_appearance, make_renderer, rgb, segmentation
from mjx_arm.scene import Scene, load_scene

__all__ = [
    "Appearance",
    "AutoReset",
    "Env",
    "EnvConfig",
    "EnvState",
    "RewardConfig",
    "Scene",
    "default_appearance",
    "load_scene",
    "make",
    "make_renderer",
    "rgb",
    "segmentation",
]

__version__ = "0.1.0"
