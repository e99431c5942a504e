"""Epsilon-greedy exploration: its schedule, and each environment's share of random actions."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import optax

from mjx_arm.config import ExplorationConfig
from mjx_arm.options import Share, check_value
from mjx_arm.shard import WHOLE, Shard


def epsilon_at(config: ExplorationConfig, env_steps: jax.Array) -> jax.Array:
    """Epsilon after a number of environment steps, `[] float32`; see `spread_epsilon`."""
    schedule = optax.schedules.linear_schedule(
        config.epsilon_start, config.epsilon_end, config.epsilon_steps
    )
    return jnp.asarray(schedule(env_steps.astype(jnp.float32)), jnp.float32)


def spread_epsilon(config: ExplorationConfig, epsilon: jax.Array, num_envs: int) -> jax.Array:
    """The share of random actions of each environment, `[num_envs] float32`.

    Their mean is `epsilon` as long as none is above 1. Those above 1 are cut to 1, which makes the
    mean smaller.
    """
    spread = config.epsilon_spread if num_envs > 1 else 1.0
    ratios = np.geomspace(1 / spread, spread, num_envs)
    return jnp.minimum(epsilon * jnp.asarray(ratios / ratios.mean(), jnp.float32), 1.0)


def check_epsilon(epsilon: float) -> None:
    """Rejects what is not a share of random actions.

    Raises:
      ValueError: it is not from 0 to 1.
    """
    check_value("epsilon", Share, epsilon)


def epsilon_greedy(
    key: jax.Array, q: jax.Array, epsilon: jax.Array, shard: Shard = WHOLE
) -> jax.Array:
    """Actions for Q-values `[N, A] float32`, `[N] int32`; consumes the key.

    Each is uniformly random with probability `epsilon`, `[] or [N] float32`, else the best. With a
    shard `N` is the number of its own rows, and the key is that of all shards together: so the
    random numbers of a row do not depend on the number of shards.
    """
    explore_key, action_key = jax.random.split(key)
    rows, num_actions = q.shape[0] * shard.count, q.shape[1]
    explore = shard.own(jax.random.uniform(explore_key, (rows,))) < epsilon
    random = shard.own(jax.random.randint(action_key, (rows,), 0, num_actions))
    return jnp.where(explore, random, jnp.argmax(q, axis=-1).astype(jnp.int32))
