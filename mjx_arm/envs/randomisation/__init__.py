"""Domain randomisation: what differs from episode to episode, sampled from a key."""

from mjx_arm.envs.randomisation.config import PRESETS, RandomisationConfig, Ranges
from mjx_arm.envs.randomisation.sampler import (
    Randomiser,
    image_varies,
    make_randomiser,
    select_rows,
)

__all__ = [
    "PRESETS",
    "RandomisationConfig",
    "Randomiser",
    "Ranges",
    "image_varies",
    "make_randomiser",
    "select_rows",
]
