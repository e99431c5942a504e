"""What an algorithm is: a learner whose Q-values act, and updates from the replay."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import jax

from mjx_arm.algos.frames import Frame, Frames, Obs
from mjx_arm.algos.replay import Replay

Learner = Any
Params = Any


class Algorithm(Protocol):
    """A learning algorithm for one seed; its functions are pure."""

    @property
    def frames(self) -> Frames:
        """What the policy sees of the environments, and what the replay stores of that."""
        ...

    @property
    def metrics(self) -> Mapping[str, str]:
        """Names of the sums that `learn` returns -> the count, also returned, of their terms."""
        ...

    def init(self, key: jax.Array, obs: Obs, frame: Frame) -> Learner:
        """A fresh learner. Consumes the key; `obs` and `frame` of one environment give shapes."""
        ...

    def acts_on_obs(self, env_steps: jax.Array) -> jax.Array | bool:
        """Whether `q_values` looks at `obs` at this time, `[] bool`; else none is rendered."""
        ...

    def q_values(self, learner: Learner, obs: Obs, frame: Frame, env_steps: jax.Array) -> jax.Array:
        """Q-values that act in the training environments, `[N, A] float32`."""
        ...

    def learn(
        self, key: jax.Array, learner: Learner, replay: Replay, env_steps: jax.Array
    ) -> tuple[Learner, dict[str, jax.Array]]:
        """The updates after one step of all environments. Consumes the key.

        Returns:
          The learner after, and the sums and counts that `metrics` names, `[]` each.
        """
        ...

    def policy(self, learner: Learner) -> Params:
        """Parameters to judge and to save."""
        ...

    def with_policy(self, learner: Learner, params: Params) -> Learner:
        """The learner with these parameters of its policy, to train them further."""
        ...

    def apply(self, params: Params, obs: Obs) -> jax.Array:
        """Q-values of the policy that is judged, `[N, A] float32`."""
        ...

    def init_policy(self, key: jax.Array, obs: Obs) -> Params:
        """Fresh parameters of the policy. Consumes the key."""
        ...
