"""The stand-in for reality: MuJoCo's C physics and MuJoCo's own OpenGL renderer, a little off.

No part of the training imports it. An agent that was trained in the simulator runs here unchanged.
"""

from mjx_arm.standin.episodes import Job, Start, Trace, run_episodes
from mjx_arm.standin.levels import LEVELS, Offsets, find_level
from mjx_arm.standin.world import StandIn

__all__ = [
    "LEVELS",
    "Job",
    "Offsets",
    "StandIn",
    "Start",
    "Trace",
    "find_level",
    "run_episodes",
]
