"""Evaluation: a fixed number of episodes in every environment, all of them counted."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from mjx_arm.auto_reset import AutoReset, AutoResetState
from mjx_arm.dqn import check_epsilon, epsilon_greedy
from mjx_arm.env import Env
from mjx_arm.physics import compiler_options

# Environments side by side, and iterations in one compiled call.
_MAX_ENVS = 200
_CHUNK = 100
_WILSON_Z = 1.959964


@dataclasses.dataclass(frozen=True)
class Evaluation:
    """What so many episodes came to.

    Attributes:
      episodes: all that were started.
      successes: those that ended with the cube lifted.
      rate: their share.
      ci95: Wilson's interval of the share, 95 %.
      mean_length: iterations of an episode, failures included.
      grasp_rate: share of the episodes with at least one grasp.
      regrasps: mean number of grasps after the first one, in an episode.
    """

    episodes: int
    successes: int
    rate: float
    ci95: tuple[float, float]
    mean_length: float
    grasp_rate: float
    regrasps: float


@flax.struct.dataclass
class _Run:
    envs: AutoResetState
    obs: Any
    key: jax.Array
    left: jax.Array
    grasps: jax.Array
    held: jax.Array
    totals: dict[str, jax.Array]


def make_evaluator(
    env: Env, apply: Callable[[Any, jax.Array], jax.Array], *, episodes: int, epsilon: float
) -> Callable[[Any, int], Evaluation]:
    """Makes `(params, seed) -> Evaluation`, which runs an epsilon-greedy policy; compiles once.

    Each environment runs a number of episodes that is fixed beforehand, to their ends: the first
    so many to finish would favour short ones, and with them successes.

    Args:
      env: made with the observation that the network wants.
      apply: `(params, obs [N, ...]) -> Q-values [N, A]`.
      episodes: how many.
      epsilon: share of random actions.

    Returns:
      A function of the network's parameters and of a seed for starts and random actions.

    Raises:
      ValueError: `episodes` below 1, or `epsilon` outside 0 to 1.
    """
    if episodes < 1:
        raise ValueError(f"episodes is {episodes}: give at least 1")
    check_epsilon(epsilon)
    auto = AutoReset(env)

    def advance_run(params: Any, run: _Run) -> _Run:
        step = functools.partial(_step, auto, apply, params, epsilon)
        return jax.lax.fori_loop(0, _CHUNK, lambda _, run: step(run), run)

    advance = jax.jit(advance_run, compiler_options=compiler_options(env.physics))
    start = jax.jit(functools.partial(_start, auto, episodes))

    def evaluate_params(params: Any, seed: int) -> Evaluation:
        run = start(jax.random.key(seed))
        while int(jnp.max(run.left)) > 0:
            run = advance(params, run)
        totals = {name: int(total) for name, total in run.totals.items()}
        assert totals["episodes"] == episodes
        return Evaluation(
            episodes=episodes,
            successes=totals["successes"],
            rate=totals["successes"] / episodes,
            ci95=wilson_interval(totals["successes"], episodes),
            mean_length=totals["length"] / episodes,
            grasp_rate=totals["grasped"] / episodes,
            regrasps=totals["regrasps"] / episodes,
        )

    return evaluate_params


def evaluate(
    env: Env,
    apply: Callable[[Any, jax.Array], jax.Array],
    params: Any,
    *,
    episodes: int,
    epsilon: float,
    seed: int,
) -> Evaluation:
    """Runs one policy once; see `make_evaluator`."""
    return make_evaluator(env, apply, episodes=episodes, epsilon=epsilon)(params, seed)


def _start(auto: AutoReset, episodes: int, key: jax.Array) -> _Run:
    num_envs = min(episodes, _MAX_ENVS)
    reset_key, key = jax.random.split(key)
    obs, envs = jax.vmap(auto.reset)(jax.random.split(reset_key, num_envs))
    quota = np.full(num_envs, episodes // num_envs)
    quota[: episodes % num_envs] += 1
    names = ("episodes", "successes", "length", "grasped", "regrasps")
    return _Run(
        envs=envs,
        obs=obs,
        key=key,
        left=jnp.asarray(quota, jnp.int32),
        grasps=jnp.zeros((num_envs,), jnp.int32),
        held=jnp.zeros((num_envs,), jnp.bool_),
        totals={name: jnp.zeros((), jnp.int32) for name in names},
    )


def _step(
    auto: AutoReset,
    apply: Callable[[Any, jax.Array], jax.Array],
    params: Any,
    epsilon: float,
    run: _Run,
) -> _Run:
    key, act_key, env_key = jax.random.split(run.key, 3)
    action = epsilon_greedy(act_key, apply(params, run.obs), jnp.float32(epsilon))
    keys = jax.random.split(env_key, len(run.left))
    envs, transition = jax.vmap(auto.transition)(keys, run.envs, action)
    counted = run.left > 0
    ended = (transition.terminated | transition.truncated) & counted
    held = transition.info["grasped"]
    grasps = run.grasps + (held & ~run.held).astype(jnp.int32)
    stepped = counted & ~transition.info["reset"]
    counts = {
        "episodes": ended,
        "successes": ended & transition.terminated,
        "length": stepped,
        "grasped": ended & (grasps > 0),
        "regrasps": jnp.where(ended, jnp.maximum(grasps - 1, 0), 0),
    }
    return _Run(
        envs=envs,
        obs=jax.vmap(auto.env.observe)(envs.env),
        key=key,
        left=run.left - ended.astype(jnp.int32),
        grasps=jnp.where(ended, 0, grasps),
        held=held & ~ended,
        totals={
            name: run.totals[name] + jnp.sum(count.astype(jnp.int32))
            for name, count in counts.items()
        },
    )


def newcombe_interval(
    successes: int, episodes: int, other_successes: int, other_episodes: int
) -> tuple[float, float]:
    """Newcombe's 95 % hybrid score interval of the difference of two shares (Newcombe 1998).

    Of the first minus the second, from Wilson's intervals of both.
    """
    p, q = successes / episodes, other_successes / other_episodes
    p_low, p_high = wilson_interval(successes, episodes)
    q_low, q_high = wilson_interval(other_successes, other_episodes)
    return (
        p - q - math.hypot(p - p_low, q_high - q),
        p - q + math.hypot(p_high - p, q - q_low),
    )


def wilson_interval(successes: int, episodes: int) -> tuple[float, float]:
    """Wilson's 95 % score interval of a share (Wilson 1927): lower and upper bound."""
    rate, z2 = successes / episodes, _WILSON_Z**2
    centre = rate + z2 / (2 * episodes)
    spread = math.sqrt(rate * (1 - rate) / episodes + z2 / (4 * episodes**2))
    scale = 1 + z2 / episodes
    low = (centre - _WILSON_Z * spread) / scale
    high = (centre + _WILSON_Z * spread) / scale
    # The two ends are exact where all or none succeeded, but for rounding.
    return (0.0 if successes == 0 else low), (1.0 if successes == episodes else high)
