"""The environments behind the interfaces of other libraries.

Importing this registers each task's environments with gymnasium, such as `mjx_arm/LiftA-v0` and
`mjx_arm/LiftB-v0` (also by their older names, `mjx_arm/ArmCubeA-v0` and `mjx_arm/ArmCubeB-v0`), and
those of each task that is registered later: a task `raise_hand` becomes `mjx_arm/RaiseHandA-v0`.
The adapters to gymnax are in `mjx_arm.interop.gymnax_env`, the one to Stable-Baselines3's `VecEnv`
in `mjx_arm.interop.sb3`, because they need those libraries installed.
"""

import gymnasium

from mjx_arm.envs.tasks import on_register
from mjx_arm.interop.gymnasium_env import ArmCubeEnv, ArmCubeVectorEnv

__all__ = ["ArmCubeEnv", "ArmCubeVectorEnv"]


def _register(prefix: str, task: str) -> None:
    for env in ("A", "B"):
        name = f"mjx_arm/{prefix}{env}-v0"
        if name in gymnasium.registry:
            raise ValueError(
                f"the task {task!r} would have the gymnasium id {name!r} of another task: "
                "give it another name"
            )
        gymnasium.register(
            name,
            entry_point="mjx_arm.interop.gymnasium_env:ArmCubeEnv",
            vector_entry_point="mjx_arm.interop.gymnasium_env:ArmCubeVectorEnv",
            kwargs={"name": env, "task": task},
        )


def _register_task(task: str) -> None:
    _register("".join(part.title() for part in task.split("_")), task)


_register("ArmCube", "lift")
on_register(_register_task)
