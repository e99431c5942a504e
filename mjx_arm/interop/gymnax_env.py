"""The environments as gymnax environments: `step` of version 1 (six values) or older (five)."""

from __future__ import annotations

from functools import partial
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp

from mjx_arm.envs.env import make
from mjx_arm.envs.state import EnvState
from mjx_arm.interop.gymnasium_env import observation_space

try:
    from gymnax.environments import spaces
    from gymnax.environments.environment import Environment, EnvParams
except ImportError as error:
    raise ImportError("gymnax is not installed: pip install 'mjx_arm[gymnax]'") from error


class GymnaxEnv(Environment):
    """An environment of gymnax 1.0: `step` gives six values and resets in the same step.

    `info["final_observation"]` has the true last observation of an episode, at every step. In
    environment B the cube keeps its place after a failed episode; see `mjx_arm.Env.restart`.

    Args:
      name: environment, `"A"` or `"B"`.
      **options: fields of `EnvConfig`, but for `rgbd`: gymnax has no space for it.

    Raises:
      ValueError: unknown environment or option, or an invalid value.
    """

    def __init__(self, name: str = "A", **options: Any):
        self.env = make(name, **options)
        space = observation_space(self.env)
        if not isinstance(space, gymnasium.spaces.Box):
            raise ValueError("observation 'rgbd' has no gymnax space: give another observation")
        self._space = space

    @property
    def default_params(self) -> EnvParams:
        """Parameters that truncate episodes after `EnvConfig.max_steps`."""
        return EnvParams(max_steps_in_episode=self.env.config.max_steps)

    @partial(jax.jit, static_argnames=("self",))
    def step(
        self, key: jax.Array, state: EnvState, action: Any, params: EnvParams | None = None
    ) -> tuple[Any, EnvState, jax.Array, jax.Array, jax.Array, dict[str, Any]]:
        """Advances by one iteration, and resets where that ended the episode.

        Returns:
          observation, state, reward, terminated, truncated and info.
        """
        params = self.default_params if params is None else params
        state, transition = self.env.transition(state, jnp.asarray(action, jnp.int32))
        # Only by the length in `params`, which may be longer than `EnvConfig.max_steps`.
        too_long = state.step >= params.max_steps_in_episode
        truncated = (too_long | transition.info["diverged"]) & ~transition.terminated
        ended = transition.terminated | truncated
        final = self.env.observe(state)
        fresh = self.env.restart(key, state, wanted=ended)
        first = self.env.observe(fresh)
        obs, state = jax.tree.map(
            lambda a, b: jnp.where(ended, a, b), (first, fresh), (final, state)
        )
        info: dict[str, Any] = {**transition.metrics, **transition.info}
        info |= {
            "terminated": transition.terminated,
            "truncated": truncated,
            "final_observation": final,
        }
        return obs, state, transition.reward, transition.terminated, truncated, info

    def reset_env(self, key: jax.Array, params: EnvParams) -> tuple[Any, EnvState]:
        """Starts an episode that does not depend on earlier ones."""
        del params
        return self.env.reset(key)

    @property
    def name(self) -> str:
        """Name of the environment."""
        return f"mjx_arm-{self.env.config.task}-{self.env.config.env}"

    @property
    def num_actions(self) -> int:
        """Number of discrete actions."""
        return self.env.num_actions

    def action_space(self, params: EnvParams | None = None) -> spaces.Discrete:
        """Space of the actions."""
        del params
        return spaces.Discrete(self.num_actions)

    def observation_space(self, params: EnvParams | None = None) -> spaces.Box:
        """Space of the observations."""
        del params
        space = self._space
        return spaces.Box(space.low.min(), space.high.max(), space.shape, space.dtype)


class ClassicGymnaxEnv(GymnaxEnv):
    """The same for trainers written for gymnax before 1.0: `step` gives five values, with `done`.

    `info` still has `terminated` and `truncated`.
    """

    def step(  # type: ignore[override]
        self, key: jax.Array, state: EnvState, action: Any, params: EnvParams | None = None
    ) -> tuple[Any, EnvState, jax.Array, jax.Array, dict[str, Any]]:
        """Advances by one iteration: observation, state, reward, done and info."""
        obs, state, reward, terminated, truncated, info = super().step(key, state, action, params)
        return obs, state, reward, terminated | truncated, info
