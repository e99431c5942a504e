"""Deep Q-learning: targets, loss, one update of the parameters, and the algorithm."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import chex
import flax.struct
import jax
import jax.numpy as jnp
import optax

from mjx_arm.algos.frames import Frame, Frames, Obs
from mjx_arm.algos.replay import Batch, Replay, sample
from mjx_arm.config import DQNConfig
from mjx_arm.microbatch import microbatched
from mjx_arm.shard import WHOLE, Shard

Params = Any


@flax.struct.dataclass
class Learner:
    """What Q-learning changes.

    Attributes:
      params: of the online network.
      target_params: of the target network.
      opt_state: of the optimizer.
      updates: `[] int32`, updates so far.
    """

    params: Params
    target_params: Params
    opt_state: optax.OptState
    updates: jax.Array


@dataclasses.dataclass(frozen=True)
class QLearning:
    """One update of a Q-network and its target network; the functions are pure.

    Attributes:
      apply: `(params, obs [B, ...]) -> Q-values [B, A] float32`.
      init_params: `(key, obs [B, ...]) -> params`.
      optimizer: of the online network.
      double: the online network picks the action whose target value counts (van Hasselt 2015).
      huber: Huber loss with threshold 1; else half the squared error.
      polyak: share of the online parameters in each update of the target's, or 0.
      target_period: updates between copies to the target network, where `polyak` is 0.
      microbatches: number of equal parts of a batch; their gradients are added. What a part needs
        in between may fit a cache where that of the whole batch does not.
      shard: the part of a batch that `update` gets; the gradients are those of the whole batch.
    """

    apply: Callable[[Params, jax.Array], jax.Array]
    init_params: Callable[[jax.Array, jax.Array], Params]
    optimizer: optax.GradientTransformation
    double: bool
    huber: bool
    polyak: float
    target_period: int
    microbatches: int = 1
    shard: Shard = WHOLE

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
            # A copy, because a donated carry may not hold one buffer twice.
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
        # The mean over the shards of the sums below is the weighted mean over the whole batch.
        total = jnp.maximum(self.shard.mean(jnp.sum(batch.weight)), 1.0 / self.shard.count)
        # Zeros where a transition is masked: its frame may hold NaN, and 0 times NaN is NaN.
        obs, next_obs = (_zero_where_masked(x, batch.weight) for x in (obs, next_obs))
        rows = (batch.action, batch.reward, batch.discount, batch.weight / total, obs, next_obs)
        if self.microbatches == 1:
            grads, metrics = self._gradients(learner, *rows)
        else:
            shape = (self.microbatches, len(batch.action) // self.microbatches)
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
        largest = self.shard.largest(metrics["target_max"])
        grads, metrics = self.shard.mean((grads, metrics))
        metrics |= {"target_max": largest}
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
            losses = optax.losses.huber_loss(errors) if self.huber else optax.losses.l2_loss(errors)
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


def _zero_where_masked(obs: Any, weight: jax.Array) -> Any:
    def zero(x: jax.Array) -> jax.Array:
        valid = (weight > 0).reshape(-1, *(1,) * (x.ndim - 1))
        return jnp.where(valid, x, jnp.zeros_like(x))

    return jax.tree.map(zero, obs)


def make_q_learning(
    config: DQNConfig, network: Any, *, pixels: bool, shard: Shard = WHOLE
) -> QLearning:
    """Q-learning of a Flax module, with the options of `DQNConfig`."""
    return QLearning(
        apply=lambda params, obs: microbatched(lambda rows: network.apply(params, rows))(obs),
        init_params=network.init,
        optimizer=make_adam(config.learning_rate, config.max_grad_norm),
        double=config.double,
        huber=config.huber,
        polyak=config.polyak,
        target_period=config.target_period,
        microbatches=num_microbatches(shard.part(config.batch_size)) if pixels else 1,
        shard=shard,
    )


def make_adam(learning_rate: float, max_grad_norm: float) -> optax.GradientTransformation:
    """Adam, after clipping to a global norm if that is above 0."""
    adam = optax.adam(learning_rate)
    if max_grad_norm == 0.0:
        return adam
    return optax.chain(optax.clip_by_global_norm(max_grad_norm), adam)


def num_microbatches(batch_size: int) -> int:
    """Parts of a batch of images: on a CPU of 16 each, whose patches fit the cache of a core.

    Four parts of 16 take three quarters of the time of 64 at once (see benchmarks/PROFILE.md).
    """
    on_cpu = jax.default_backend() == "cpu"
    return batch_size // 16 if on_cpu and batch_size % 16 == 0 else 1


@dataclasses.dataclass(frozen=True, eq=False)
class DQN:
    """Deep Q-learning (Mnih et al. 2015) as an `Algorithm`.

    Attributes:
      config: the options.
      frames: what the network sees, and what the replay stores of it.
      q_learning: the update.
      num_envs: environments that run side by side.
    """

    config: DQNConfig
    frames: Frames
    q_learning: QLearning
    num_envs: int
    metrics: Mapping[str, str] = dataclasses.field(
        default_factory=lambda: dict.fromkeys(("loss", "q_mean", "target_max"), "updates")
    )

    def init(self, key: jax.Array, obs: Obs, frame: Frame) -> Learner:
        """A fresh learner; see `Algorithm`."""
        del frame
        return self.q_learning.init(key, obs)

    def init_policy(self, key: jax.Array, obs: Obs) -> Params:
        """Fresh parameters of the network. Consumes the key."""
        return self.q_learning.init_params(key, obs)

    def acts_on_obs(self, env_steps: jax.Array) -> bool:
        """The network always acts on its observations."""
        del env_steps
        return True

    def q_values(self, learner: Learner, obs: Obs, frame: Frame, env_steps: jax.Array) -> jax.Array:
        """Q-values of the online network, `[N, A] float32`."""
        del frame, env_steps
        return self.q_learning.apply(learner.params, obs)

    def policy(self, learner: Learner) -> Params:
        """Parameters to judge and to save; see `QLearning.policy`."""
        return self.q_learning.policy(learner)

    def with_policy(self, learner: Learner, params: Params) -> Learner:
        """The learner with these parameters in both networks."""
        return dataclasses.replace(
            learner, params=params, target_params=jax.tree.map(jnp.copy, params)
        )

    def apply(self, params: Params, obs: Obs) -> jax.Array:
        """Q-values of the network, `[N, A] float32`."""
        return self.q_learning.apply(params, obs)

    def learn(
        self, key: jax.Array, learner: Learner, replay: Replay, env_steps: jax.Array
    ) -> tuple[Learner, dict[str, jax.Array]]:
        """The updates of one step; none while the replay holds too little."""
        del env_steps
        config, shard = self.config, self.q_learning.shard

        def update(learner: Learner, key: jax.Array) -> tuple[Learner, dict[str, jax.Array]]:
            size = shard.part(config.batch_size)
            batch = sample(replay, shard.fold(key), size, config.n_step, config.gamma)
            obs = self.frames.decode(batch.frame)
            next_obs = self.frames.decode(batch.next_frame)
            return self.q_learning.update(learner, batch, obs, next_obs)

        ready = replay.count > first_update(config, self.num_envs)
        return update_when(ready, update, key, learner, config.updates_per_step, self.metrics)


def first_update(config: Any, num_envs: int) -> int:
    """Time steps in the replay before the first update."""
    return max(config.learning_starts // num_envs, config.n_step + 1)


def update_when(
    ready: jax.Array,
    update: Callable[[Any, jax.Array], tuple[Any, dict[str, jax.Array]]],
    key: jax.Array,
    learner: Any,
    times: int,
    metrics: Mapping[str, str],
) -> tuple[Any, dict[str, jax.Array]]:
    """A number of updates if `ready`, else none.

    Args:
      ready: `[] bool`.
      update: `(learner, key) -> (learner, metrics)`.
      key: consumed.
      learner: before.
      times: number of updates.
      metrics: names of the metrics of `update` -> the name of the count of updates.

    Returns:
      The learner after, and the sums of the metrics with their count.
    """
    (count,) = set(metrics.values())

    def learn(learner: Any) -> tuple[Any, dict[str, jax.Array]]:
        keys = jax.random.split(key, times)
        if times == 1:
            learner, sums = update(learner, keys[0])
        else:
            learner, each = jax.lax.scan(update, learner, keys)
            sums = jax.tree.map(lambda x: jnp.sum(x, axis=0), each)
        return learner, sums | {count: jnp.full((), times, jnp.float32)}

    def wait(learner: Any) -> tuple[Any, dict[str, jax.Array]]:
        return learner, {name: jnp.zeros((), jnp.float32) for name in (*metrics, count)}

    return jax.lax.cond(ready, learn, wait, learner)
