"""One acting step of all environments and the statistics of their episodes.

The training loop, the evaluation and the videos share it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp

from mjx_arm.algos.exploration import epsilon_greedy
from mjx_arm.envs.auto_reset import AutoReset, AutoResetState
from mjx_arm.envs.state import Transition
from mjx_arm.shard import WHOLE, Shard

Counts = dict[str, jax.Array]


@flax.struct.dataclass
class Episodes:
    """Running sums of the episodes under way, `[N] float32` each.

    Attributes:
      length: steps.
      reward: sum of the rewards.
      max_q: sum of the largest Q-values.
      onsets: for each bool metric, how often it became true.
      now: for each bool metric, whether it is true, as 0 or 1.
    """

    length: jax.Array
    reward: jax.Array
    max_q: jax.Array
    onsets: dict[str, jax.Array]
    now: dict[str, jax.Array]


def init_episodes(auto: AutoReset, envs: AutoResetState) -> Episodes:
    """The sums at the start of the episodes of `envs [N]`."""
    one = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), envs)
    transition = jax.eval_shape(lambda e: auto.transition(jax.random.key(0), e, 0)[1], one)
    names = [name for name, x in transition.metrics.items() if x.dtype == jnp.bool_]

    def zero() -> jax.Array:
        return jnp.zeros(envs.ended.shape, jnp.float32)

    return Episodes(
        zero(), zero(), zero(), {name: zero() for name in names}, {name: zero() for name in names}
    )


def act(
    auto: AutoReset,
    key: jax.Array,
    envs: AutoResetState,
    q: jax.Array,
    epsilon: jax.Array,
    shard: Shard = WHOLE,
) -> tuple[jax.Array, AutoResetState, Transition]:
    """Acts epsilon-greedily in all environments. Consumes the key.

    Args:
      auto: the environment.
      key: a PRNG key.
      envs: `[N]` environments.
      q: `[N, A] float32`, Q-values of what they show.
      epsilon: `[]` or `[N] float32`, share of random actions.
      shard: where `envs` are those of one shard and `key` is that of all shards together.

    Returns:
      The actions `[N] int32`, the environments after, and the transitions.
    """
    act_key, env_key = jax.random.split(key)
    action = epsilon_greedy(act_key, q, epsilon, shard)
    keys = shard.own(jax.random.split(env_key, len(q) * shard.count))
    envs, transition = jax.vmap(auto.transition)(keys, envs, action)
    return action, envs, transition


def count_episodes(
    episodes: Episodes, transition: Transition, q: jax.Array, counted: jax.Array | bool = True
) -> tuple[Episodes, Counts]:
    """Adds a step to the statistics.

    Args:
      episodes: the sums before.
      transition: of all environments.
      q: `[N, A] float32`, Q-values that the step was chosen by.
      counted: `[N] bool`, environments that count.

    Returns:
      The sums after, and the step's counts, `[] float32`: of steps (`steps`, `blocked`,
      `diverged`, `M_steps` where the bool metric M was true, `M_sum` of each other metric M) and
      of episodes that ended (`episodes`, `successes`; their `episode_length`, `episode_reward` and
      `episode_max_q`; `M_episodes` in which M was true at some time, `M_failed_episodes` of these
      without success, `M_onsets` how often it became true).
    """
    info = transition.info
    stepped = (~info["reset"] & counted).astype(jnp.float32)
    ended = (transition.terminated | transition.truncated) & counted
    flags = {
        name: x.astype(jnp.float32)
        for name, x in transition.metrics.items()
        if name in episodes.now
    }
    after = Episodes(
        length=episodes.length + stepped,
        reward=episodes.reward + transition.reward * stepped,
        max_q=episodes.max_q + stepped * jnp.max(q, axis=-1),
        onsets={
            name: episodes.onsets[name] + stepped * flag * (1 - episodes.now[name])
            for name, flag in flags.items()
        },
        now=flags,
    )
    failed = ended & ~transition.terminated

    def total(values: Any) -> jax.Array:
        return jnp.sum(jnp.asarray(values, jnp.float32))

    counts = {
        "steps": total(stepped),
        "blocked": total(stepped * info["blocked"].astype(jnp.float32)),
        "diverged": total(info["diverged"] & counted),
        "episodes": total(ended),
        "successes": total(ended & transition.terminated),
        "episode_length": total(jnp.where(ended, after.length, 0.0)),
        "episode_reward": total(jnp.where(ended, after.reward, 0.0)),
        "episode_max_q": total(jnp.where(ended, after.max_q, 0.0)),
    }
    for name, metric in transition.metrics.items():
        if name not in flags:
            counts[f"{name}_sum"] = total(stepped * metric)
            continue
        onsets = after.onsets[name]
        counts[f"{name}_steps"] = total(stepped * flags[name])
        counts[f"{name}_episodes"] = total(ended & (onsets > 0))
        counts[f"{name}_failed_episodes"] = total(failed & (onsets > 0))
        counts[f"{name}_onsets"] = total(jnp.where(ended, onsets, 0.0))
    fresh = jax.tree.map(lambda x: jnp.where(ended, 0.0, x), after)
    return fresh, counts


def means(counts: dict[str, float]) -> dict[str, float]:
    """Rates and means from counts of any length; means over nothing are NaN.

    `success_rate`; `mean_length` of an episode; `mean_reward` and `mean_max_q` of a step;
    `blocked_share` of the steps; for each bool metric M `M_share` of the steps, `M_rate` of the
    episodes, and `M_failed_rate`, episodes with M but without success; `mean_M` for the others.
    """

    def ratio(top: str, bottom: str) -> float:
        return counts[top] / counts[bottom] if counts[bottom] else float("nan")

    result = {
        "success_rate": ratio("successes", "episodes"),
        "mean_length": ratio("episode_length", "episodes"),
        "mean_reward": ratio("episode_reward", "episode_length"),
        "mean_max_q": ratio("episode_max_q", "episode_length"),
        "blocked_share": ratio("blocked", "steps"),
    }
    for name in counts:
        if name.endswith("_failed_episodes"):
            metric = name.removesuffix("_failed_episodes")
            result[f"{metric}_share"] = ratio(f"{metric}_steps", "steps")
            result[f"{metric}_rate"] = ratio(f"{metric}_episodes", "episodes")
            result[f"{metric}_failed_rate"] = ratio(name, "episodes")
        elif name.endswith("_sum"):
            result[f"mean_{name.removesuffix('_sum')}"] = ratio(name, "steps")
    return result


Apply = Callable[[Any, Any], jax.Array]
