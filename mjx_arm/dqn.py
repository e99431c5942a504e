"""Deep Q-learning: targets, loss and one update of the parameters."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import chex
import flax.struct
import jax
import jax.numpy as jnp
import optax

from mjx_arm.replay import Batch

Params = Any


@flax.struct.dataclass
class Learner:
    """What learning changes.

    Attributes:
      params: of the online network.
      target_params: of the target network.
      opt_state: of the optimiser.
      updates: `[] int32`, updates so far.
    """

    params: Params
    target_params: Params
    opt_state: optax.OptState
    updates: jax.Array


@dataclasses.dataclass(frozen=True)
class DQN:
    """The algorithm; its functions are pure.

    Attributes:
      apply: `(params, obs [B, ...]) -> Q-values [B, A] float32`.
      init_params: `(key, obs [B, ...]) -> params`.
      optimizer: of the online network.
      double: the online network picks the action whose target value counts (van Hasselt 2015).
      huber: loss of Huber with threshold 1, else half the square.
      polyak: share of the online parameters in each update of the target's, or 0.
      target_period: updates between copies to the target network, where `polyak` is 0.
      parts: a batch is worked on in so many parts of one size, and the gradients added up; what a
        part needs in between may fit a cache where that of the batch does not.
    """

    apply: Callable[[Params, jax.Array], jax.Array]
    init_params: Callable[[jax.Array, jax.Array], Params]
    optimizer: optax.GradientTransformation
    double: bool
    huber: bool
    polyak: float
    target_period: int
    parts: int = 1

    def policy(self, learner: Learner) -> Params:
        """Parameters to judge and to keep.

        Those of the target network where it averages the online one's: that takes out much of what
        the last few updates happened to do (88 % instead of 72 % of episodes, from state features).
        """
        return learner.target_params if self.polyak > 0.0 else learner.params

    def init(self, key: jax.Array, obs: jax.Array) -> Learner:
        """Fresh parameters, in both networks. Consumes the key; `obs` gives the shapes."""
        params = self.init_params(key, obs)
        return Learner(
            params=params,
            # A copy: a donated carry may not hold one buffer twice.
            target_params=jax.tree.map(jnp.copy, params),
            opt_state=self.optimizer.init(params),
            updates=jnp.zeros((), jnp.int32),
        )

    def update(
        self, learner: Learner, batch: Batch, obs: jax.Array, next_obs: jax.Array
    ) -> tuple[Learner, dict[str, jax.Array]]:
        """One gradient step.

        Args:
          learner: before.
          batch: actions, rewards, discounts and weights.
          obs: `[B, ...]`, made from `batch.frame`.
          next_obs: `[B, ...]`, made from `batch.next_frame`.

        Returns:
          The learner after, and `loss`, `q_mean` and `target_max`, each `[] float32`.
        """
        total = jnp.maximum(jnp.sum(batch.weight), 1.0)
        rows = (batch.action, batch.reward, batch.discount, batch.weight / total, obs, next_obs)
        if self.parts == 1:
            grads, metrics = self._gradients(learner, *rows)
        else:
            shape = (self.parts, len(batch.action) // self.parts)
            rows = jax.tree.map(lambda x: x.reshape(*shape, *x.shape[1:]), rows)
            zeros = jax.tree.map(jnp.zeros_like, learner.params)
            grads, each = jax.lax.scan(
                lambda grads, row: _add_first(grads, self._gradients(learner, *row)), zeros, rows
            )
            metrics = {
                "loss": jnp.sum(each["loss"]),
                "q_mean": jnp.mean(each["q_mean"]),
                "target_max": jnp.max(each["target_max"]),
            }
        # Adam's bias correction raises a float to an integer power; strict promotion is for ours.
        with jax.numpy_dtype_promotion("standard"):
            changes, opt_state = self.optimizer.update(grads, learner.opt_state, learner.params)
        params = optax.apply_updates(learner.params, changes)
        updates = learner.updates + 1
        learner = Learner(
            params=params,
            target_params=self._sync(learner.target_params, params, updates),
            opt_state=opt_state,
            updates=updates,
        )
        return learner, metrics

    def _gradients(
        self,
        learner: Learner,
        action: jax.Array,
        reward: jax.Array,
        discount: jax.Array,
        weight: jax.Array,
        obs: jax.Array,
        next_obs: jax.Array,
    ) -> tuple[Params, dict[str, jax.Array]]:
        """The gradient of the weighted sum of losses over some rows of a batch, and metrics."""
        next_q = self.apply(learner.target_params, next_obs)
        chooser = self.apply(learner.params, next_obs) if self.double else next_q
        targets = jax.vmap(td_target)(reward, discount, next_q, chooser)

        def loss_of(params: Params) -> tuple[jax.Array, jax.Array]:
            q = self.apply(params, obs)
            errors = jax.vmap(td_error)(q, action, targets)
            losses = jax.vmap(huber if self.huber else half_square)(errors)
            return jnp.sum(weight * losses), jnp.mean(jnp.max(q, axis=-1))

        (loss, q_mean), grads = jax.value_and_grad(loss_of, has_aux=True)(learner.params)
        return grads, {"loss": loss, "q_mean": q_mean, "target_max": jnp.max(targets)}

    def _sync(self, target_params: Params, params: Params, updates: jax.Array) -> Params:
        if self.polyak > 0.0:
            return optax.incremental_update(params, target_params, self.polyak)
        return optax.periodic_update(params, target_params, updates, self.target_period)


def _add_first(total: Params, result: tuple[Params, Any]) -> tuple[Params, Any]:
    grads, rest = result
    return jax.tree.map(jnp.add, total, grads), rest


def td_target(
    reward: jax.Array, discount: jax.Array, next_q: jax.Array, chooser: jax.Array
) -> jax.Array:
    """Target of one transition: `reward + discount * next_q[argmax chooser]`, `[] float32`.

    Args:
      reward: `[] float32`, n-step sum.
      discount: `[] float32`, 0 after a termination.
      next_q: `[A] float32`, of the target network.
      chooser: `[A] float32`, whose largest entry picks the action.
    """
    chex.assert_rank([reward, discount, next_q, chooser], [0, 0, 1, 1])
    return reward + discount * next_q[jnp.argmax(chooser)]


def td_error(q: jax.Array, action: jax.Array, target: jax.Array) -> jax.Array:
    """Error of one transition: `q[action] - target`, `[] float32`, for `q [A] float32`."""
    chex.assert_rank([q, action, target], [1, 0, 0])
    return q[action] - target


def huber(error: jax.Array) -> jax.Array:
    """Half the square up to 1, linear beyond: `[] float32`."""
    chex.assert_rank(error, 0)
    size = jnp.abs(error)
    return jnp.where(size <= 1.0, 0.5 * size * size, size - 0.5)


def half_square(error: jax.Array) -> jax.Array:
    """Half the square: `[] float32`."""
    chex.assert_rank(error, 0)
    return 0.5 * error * error


def check_epsilon(epsilon: float) -> None:
    """Raises ValueError for what is no share of random actions."""
    if not 0.0 <= epsilon <= 1.0:
        raise ValueError(f"epsilon is {epsilon}: give 0 to 1")


def epsilon_greedy(key: jax.Array, q: jax.Array, epsilon: jax.Array) -> jax.Array:
    """Actions for Q-values `[N, A] float32`, `[N] int32`; consumes the key.

    Each is uniformly random with probability `epsilon`, `[] or [N] float32`, else the best.
    """
    explore_key, action_key = jax.random.split(key)
    num_envs, num_actions = q.shape
    explore = jax.random.uniform(explore_key, (num_envs,)) < epsilon
    random = jax.random.randint(action_key, (num_envs,), 0, num_actions)
    return jnp.where(explore, random, jnp.argmax(q, axis=-1).astype(jnp.int32))
