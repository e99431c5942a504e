"""The environments behind the interfaces of other libraries.

Importing this registers each task's environments with gymnasium, such as `mjx_arm/LiftA-v0` and
`mjx_arm/LiftB-v0` (also by their older names, `mjx_arm/ArmCubeA-v0` and `mjx_arm/ArmCubeB-v0`).
The adapters to gymnax are in `mjx_arm.interop.gymnax_env`, the one to Stable-Baselines3's `VecEnv`
in `mjx_arm.interop.sb3`, because they need those libraries installed.
"""

import gymnasium

from mjx_arm.envs.tasks import task_names
from mjx_arm.interop.gymnasium_env import ArmCubeEnv, ArmCubeVectorEnv

__all__ = ["ArmCubeEnv", "ArmCubeVectorEnv"]


def _register(prefix: str, task: str) -> None:
    for env in ("A", "B"):
        gymnasium.register(
            f"mjx_arm/{prefix}{env}-v0",
            entry_point="mjx_arm.interop.gymnasium_env:ArmCubeEnv",
            vector_entry_point="mjx_arm.interop.gymnasium_env:ArmCubeVectorEnv",
            kwargs={"name": env, "task": task},
        )


_register("ArmCube", "lift")
for _task in task_names():
    _register("".join(part.title() for part in _task.split("_")), _task)
