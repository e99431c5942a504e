"""Auto-reset in two modes, around an environment whose own `step` never resets."""

from __future__ import annotations

import dataclasses
from typing import Any, TypeVar

import flax.struct
import jax
import jax.numpy as jnp

from mjx_arm.envs.env import Env
from mjx_arm.envs.state import EnvState, Observation, Transition

T = TypeVar("T")

MODES = ("next_step", "same_step")


@flax.struct.dataclass
class AutoResetState:
    """State of an environment that resets itself.

    Attributes:
      env: the environment's own state.
      ended: `[] bool`, the step that led here ended its episode and the reset is still to come;
        always false in mode `same_step`.
    """

    env: EnvState
    ended: jax.Array


@dataclasses.dataclass(frozen=True, eq=False)
class AutoReset:
    """An environment that starts a fresh episode when one has ended.

    In mode `next_step` (for the training loop) the step after the end ignores its action and
    resets: it returns the first frame of the next episode, reward 0, neither flag, and
    `info["reset"]` true. Every frame is thus seen once, and the one transition across the border
    can be masked. In mode `same_step` (gymnax 1.0 and gymnasium) the step that ends an episode
    returns the first observation of the next one, and the true last observation in
    `info["final_observation"]`, which is there at every step.

    Each start is sampled anew, and gets what outlives an episode; see `Env.restart`.

    Attributes:
      env: the environment.
      mode: `"next_step"` or `"same_step"`.
    """

    env: Env
    mode: str = "next_step"

    def __post_init__(self) -> None:
        """Raises ValueError for an unknown mode."""
        if self.mode not in MODES:
            raise ValueError(f"unknown auto-reset mode {self.mode!r}: give one of {MODES}")

    def reset(self, key: jax.Array) -> tuple[Observation, AutoResetState]:
        """Starts the first episode; see `Env.reset`."""
        obs, state = self.env.reset(key)
        return obs, AutoResetState(env=state, ended=jnp.zeros((), jnp.bool_))

    def step(
        self, key: jax.Array, state: AutoResetState, action: jax.Array | int
    ) -> tuple[Observation, AutoResetState, jax.Array, jax.Array, jax.Array, dict[str, Any]]:
        """Advances by one iteration, or resets; the key is consumed by the reset.

        Returns:
          observation, state, reward, terminated, truncated and info, as in `Env.step`.
        """
        if self.mode == "same_step":
            return self._same_step(key, state, action)
        state, transition = self.transition(key, state, action)
        return (
            self.env.observe(state.env),
            state,
            transition.reward,
            transition.terminated,
            transition.truncated,
            transition.metrics | transition.info,
        )

    def transition(
        self, key: jax.Array, state: AutoResetState, action: jax.Array | int
    ) -> tuple[AutoResetState, Transition]:
        """A `next_step` step without its observation."""
        stepped, transition = self.env.transition(state.env, action)
        fresh = self.env.restart(key, state.env, wanted=state.ended)
        blank = jax.tree.map(jnp.zeros_like, transition)
        transition = _select(state.ended, blank, transition)
        transition.info["reset"] = state.ended
        ended = transition.terminated | transition.truncated
        return AutoResetState(env=_select(state.ended, fresh, stepped), ended=ended), transition

    def _same_step(
        self, key: jax.Array, state: AutoResetState, action: jax.Array | int
    ) -> tuple[Observation, AutoResetState, jax.Array, jax.Array, jax.Array, dict[str, Any]]:
        stepped, transition = self.env.transition(state.env, action)
        ended = transition.terminated | transition.truncated
        fresh = self.env.restart(key, stepped, wanted=ended)
        final = self.env.observe(stepped)
        obs = _select(ended, self.env.observe(fresh), final)
        info: dict[str, Any] = {**transition.metrics, **transition.info}
        info |= {"reset": ended, "final_observation": final}
        state = AutoResetState(env=_select(ended, fresh, stepped), ended=state.ended)
        return obs, state, transition.reward, transition.terminated, transition.truncated, info


def _select(condition: jax.Array, chosen: T, other: T) -> T:
    return jax.tree.map(lambda x, y: jnp.where(condition, x, y), chosen, other)
