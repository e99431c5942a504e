"""The environments as a `VecEnv` of Stable-Baselines3, which steps them in one jitted call."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from mjx_arm.interop.gymnasium_env import ArmCubeVectorEnv


class ArmCubeVecEnv(VecEnv):
    """Many environments, for any algorithm of Stable-Baselines3.

    All environments step in one call. A single environment needs no adapter: Stable-Baselines3
    takes `ArmCubeEnv`. `infos` have `is_success`, which equals `success`, and the rest of the
    `info` of `Env.step`, such as `grasped`, `height` and `distance`.

    Args:
      name: environment, `"A"` or `"B"`.
      num_envs: number of environments.
      render_mode: None or `"rgb_array"`.
      **options: fields of `EnvConfig`.

    Raises:
      ValueError: unknown environment or option, or an invalid value.
    """

    def __init__(
        self, name: str = "A", num_envs: int = 1, render_mode: str | None = None, **options: Any
    ):
        self._envs = ArmCubeVectorEnv(name, num_envs, "same_step", render_mode, **options)
        self._actions = np.zeros(num_envs, np.int64)
        spaces = self._envs.single_observation_space, self._envs.single_action_space
        super().__init__(num_envs, *spaces)

    def reset(self) -> Any:
        """Starts an episode in every environment. Only the first of the seeds is used."""
        obs, _ = self._envs.reset(seed=self._seeds[0])
        self._reset_seeds()
        return obs

    def step_async(self, actions: np.ndarray) -> None:
        """Notes the actions `[N]` of the next `step_wait`."""
        self._actions = actions

    def step_wait(self) -> tuple[Any, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Advances every environment by one iteration; those that end begin anew."""
        obs, reward, terminated, truncated, info = self._envs.step(self._actions)
        final = info.pop("final_obs", None)
        names = [name for name in info if not name.startswith("_") and name != "final_info"]
        infos: list[dict[str, Any]] = [
            # The name by which its logs and callbacks know a success.
            {name: info[name][i] for name in names} | {"is_success": bool(info["success"][i])}
            for i in range(self.num_envs)
        ]
        ended = terminated | truncated
        for i in np.flatnonzero(ended):
            infos[i]["terminal_observation"] = final[i]
            infos[i]["TimeLimit.truncated"] = bool(truncated[i])
        return obs, reward, ended, infos

    def get_images(self) -> Sequence[np.ndarray | None]:
        """Images `[256, 256, 3] uint8` of all environments, or None without a render mode."""
        return self._envs.render() or [None] * self.num_envs

    def close(self) -> None:
        """Does nothing: there is nothing to close."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """An attribute, which all environments share, once for each index."""
        return [getattr(self._envs, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Not supported: the environments are one compiled program.

        Raises:
          AttributeError: always.
        """
        raise AttributeError(f"{attr_name} cannot be set: make the environments with other options")

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> Any:
        """Not supported: there is no single environment to call.

        Raises:
          AttributeError: always.
        """
        raise AttributeError(f"{method_name} cannot be called on one environment of many")

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """False for each index: no environment is wrapped."""
        return [False for _ in self._get_indices(indices)]
