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
from jax.sharding import PartitionSpec as P
from scipy.stats import binomtest

from mjx_arm.algos.collect import Counts, Episodes, act, count_episodes, init_episodes, means
from mjx_arm.algos.exploration import check_epsilon
from mjx_arm.envs.auto_reset import AutoReset, AutoResetState
from mjx_arm.envs.env import Env
from mjx_arm.options import Count, check_value
from mjx_arm.physics import compiler_options
from mjx_arm.shard import WHOLE, Shard
from mjx_arm.training.mesh import fetch, replicate, shard_of, sharded
from mjx_arm.training.processes import wait_for_all

# Most environments side by side, and iterations in one compiled call.
MAX_ENVS = 200
_CHUNK = 100

Apply = Callable[[Any, jax.Array], jax.Array]


@dataclasses.dataclass(frozen=True)
class Evaluation:
    """Result of a number of episodes.

    Attributes:
      episodes: all that were started.
      successes: those that ended in success.
      rate: their share.
      ci95: Wilson's 95 % interval of the share.
      mean_length: iterations of an episode, failures included.
      metrics: for each bool metric M of the task `M_rate`, the share of the episodes in which it
        was true at some time; `M_failed_rate`, the share that had it and still failed; and
        `M_again`, how often it became true after the first time, a mean over the episodes.
    """

    episodes: int
    successes: int
    rate: float
    ci95: tuple[float, float]
    mean_length: float
    metrics: dict[str, float]


@flax.struct.dataclass
class _Run:
    envs: AutoResetState
    obs: Any
    key: jax.Array
    left: jax.Array
    running: Episodes
    counts: Counts


def make_evaluator(
    env: Env,
    apply: Apply,
    *,
    episodes: int,
    epsilon: float,
    mesh: jax.sharding.Mesh | None = None,
) -> Callable[[Any, jax.Array], Evaluation]:
    """Makes `(params, key) -> Evaluation`, which runs an epsilon-greedy policy; compiles once.

    Each environment runs a number of episodes that is fixed beforehand, to their ends. Counting
    the first episodes that finish would favour short ones, and with them successes.

    Args:
      env: made with the observation that the network wants.
      apply: `(params, obs [N, ...]) -> Q-values [N, A]`.
      episodes: how many.
      epsilon: share of random actions.
      mesh: devices to spread the environments over, by its one axis. Starts and random actions do
        not depend on their number. With several processes all of them must evaluate.

    Returns:
      A function of the network's parameters and of a key for starts and random actions.

    Raises:
      ValueError: `episodes` below 1, or `epsilon` outside 0 to 1.
    """
    check_value("episodes", Count, episodes)
    check_epsilon(epsilon)
    start, advance = make_programs(env, apply, episodes=episodes, epsilon=epsilon, mesh=mesh)

    several = mesh is not None and mesh.size > len(mesh.local_devices)
    compiled: list[Callable[..., Any]] = []

    def evaluate_params(params: Any, key: jax.Array) -> Evaluation:
        params, run, left = replicate(params, mesh), start(replicate(key, mesh)), 1
        if several and not compiled:
            compiled.append(advance.lower(params, run).compile())
            # Processes do not compile equally long, and one that computes does not wait for long.
            wait_for_all()
        step = compiled[0] if compiled else advance
        while left > 0:
            run, most = step(params, run)
            left = int(most)
        return _summarise(fetch(run.counts), episodes)

    return evaluate_params


def make_programs(
    env: Env,
    apply: Apply,
    *,
    episodes: int,
    epsilon: float,
    mesh: jax.sharding.Mesh | None,
) -> tuple[jax.stages.Wrapped, jax.stages.Wrapped]:
    """The compiled functions of an evaluator; see `make_evaluator`.

    Returns:
      `key -> run`, and `(params, run) -> (run, most episodes that an environment has left)`.
    """
    auto, shard = AutoReset(env), shard_of(mesh)

    def advance_run(params: Any, run: _Run) -> tuple[_Run, jax.Array]:
        step = functools.partial(_step, auto, apply, params, epsilon, shard)
        run = dataclasses.replace(run, counts=shard.keep_first(run.counts))
        run = jax.lax.fori_loop(0, _CHUNK, lambda _, run: step(run), run)
        run = dataclasses.replace(run, counts=shard.total(run.counts))
        return run, shard.largest(jnp.max(run.left))

    specs = _specs(shard)
    advance = jax.jit(
        sharded(advance_run, mesh, (P(), specs), (specs, P())),
        compiler_options=compiler_options(env.physics),
    )
    start = jax.jit(
        sharded(functools.partial(_start, auto, episodes, shard=shard), mesh, P(), specs)
    )
    return start, advance


def _summarise(totals: dict[str, Any], episodes: int) -> Evaluation:
    counts = {name: float(total) for name, total in totals.items()}
    assert counts["episodes"] == episodes
    successes = int(counts["successes"])
    metrics = {}
    for name, mean in means(counts).items():
        if name.endswith("_rate") and name != "success_rate":
            metrics[name] = mean
    for name in counts:
        if name.endswith("_onsets"):
            metric = name.removesuffix("_onsets")
            again = counts[name] - counts[f"{metric}_episodes"]
            metrics[f"{metric}_again"] = again / episodes
    return Evaluation(
        episodes=episodes,
        successes=successes,
        rate=successes / episodes,
        ci95=wilson_interval(successes, episodes),
        mean_length=counts["episode_length"] / episodes,
        metrics=metrics,
    )


def evaluate(
    env: Env,
    apply: Apply,
    params: Any,
    *,
    episodes: int,
    epsilon: float,
    key: jax.Array,
    mesh: jax.sharding.Mesh | None = None,
) -> Evaluation:
    """Runs one policy once; see `make_evaluator`."""
    evaluator = make_evaluator(env, apply, episodes=episodes, epsilon=epsilon, mesh=mesh)
    return evaluator(params, key)


def _specs(shard: Shard) -> _Run:
    """How a run is spread over the shards."""
    own: Any = P(shard.axis)
    everywhere: Any = P()
    return _Run(own, own, everywhere, own, own, everywhere)


def _start(auto: AutoReset, episodes: int, key: jax.Array, shard: Shard = WHOLE) -> _Run:
    side_by_side = min(episodes, MAX_ENVS)
    # Each shard has as many environments; those that are left over run no episode.
    num_envs = -(-side_by_side // shard.count)
    rows = num_envs * shard.count
    reset_key, key = jax.random.split(key)
    obs, envs = jax.vmap(auto.reset)(shard.own(jax.random.split(reset_key, rows)))
    quota = np.zeros(rows, int)
    quota[:side_by_side] = episodes // side_by_side
    quota[: episodes % side_by_side] += 1
    run = _Run(
        envs=envs,
        obs=obs,
        key=key,
        left=shard.own(jnp.asarray(quota, jnp.int32)),
        running=init_episodes(auto, envs),
        counts={},
    )
    # One abstract step says which counts there are.
    q = jax.ShapeDtypeStruct((num_envs, auto.env.num_actions), jnp.float32)
    names = jax.eval_shape(lambda run, q: _count(auto, run, key, q, 0.0, shard)[1].counts, run, q)
    return dataclasses.replace(
        run, counts={name: jnp.zeros((), x.dtype) for name, x in names.items()}
    )


def _step(
    auto: AutoReset, apply: Apply, params: Any, epsilon: float, shard: Shard, run: _Run
) -> _Run:
    key, act_key = jax.random.split(run.key)
    envs, run = _count(auto, run, act_key, apply(params, run.obs), epsilon, shard)
    obs = jax.vmap(auto.env.observe)(envs.env)
    return dataclasses.replace(run, envs=envs, obs=obs, key=key)


def _count(
    auto: AutoReset, run: _Run, key: jax.Array, q: jax.Array, epsilon: float, shard: Shard
) -> tuple[AutoResetState, _Run]:
    _, envs, transition = act(auto, key, run.envs, q, jnp.float32(epsilon), shard)
    counted = run.left > 0
    running, counts = count_episodes(run.running, transition, q, counted)
    ended = (transition.terminated | transition.truncated) & counted
    return envs, dataclasses.replace(
        run,
        left=run.left - ended.astype(jnp.int32),
        running=running,
        counts={name: run.counts.get(name, 0.0) + count for name, count in counts.items()},
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
    interval = binomtest(successes, episodes).proportion_ci(0.95, method="wilson")
    # The two ends are exact where all or none succeeded, but for rounding.
    low = 0.0 if successes == 0 else float(interval.low)
    return low, 1.0 if successes == episodes else float(interval.high)
