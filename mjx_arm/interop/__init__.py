"""The environments as other libraries want them.

Importing this registers `mjx_arm/ArmCubeA-v0` and `mjx_arm/ArmCubeB-v0` with gymnasium. The
adapters to gymnax are in `mjx_arm.interop.gymnax_env`, that to Stable-Baselines3's `VecEnv` in
`mjx_arm.interop.sb3`, since they need those installed.
"""

import gymnasium

from mjx_arm.config import ENVIRONMENTS
from mjx_arm.interop.gymnasium_env import ArmCubeEnv, ArmCubeVectorEnv

__all__ = ["ArmCubeEnv", "ArmCubeVectorEnv"]

for _name in ENVIRONMENTS:
    gymnasium.register(
        f"mjx_arm/ArmCube{_name}-v0",
        entry_point="mjx_arm.interop.gymnasium_env:ArmCubeEnv",
        vector_entry_point="mjx_arm.interop.gymnasium_env:ArmCubeVectorEnv",
        kwargs={"name": _name},
    )
