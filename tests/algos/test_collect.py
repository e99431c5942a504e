"""Statistics of episodes against a plain Python loop."""

from __future__ import annotations

import collections
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_arm.algos.collect import count_episodes, init_episodes, means
from mjx_arm.envs.auto_reset import AutoResetState
from mjx_arm.envs.state import Transition

STEPS, ENVS, ACTIONS = 60, 5, 4


class Stub:
    """As much of an `AutoReset` as `init_episodes` looks at."""

    def transition(self, key, state, action):
        del key, action
        return state, jax.tree.map(lambda x: x[0, 0], random_steps(0)[0])


def random_steps(seed: int) -> tuple[Transition, np.ndarray]:
    """Transitions `[STEPS, ENVS]` as auto-reset makes them, and Q-values."""
    random = np.random.default_rng(seed)
    shape = (STEPS, ENVS)
    ends, succeeds = random.random(shape) < 0.12, random.random(shape) < 0.5
    reset = np.zeros(shape, bool)
    for step in range(1, STEPS):
        reset[step] = (ends & ~reset)[step - 1]
    ends &= ~reset
    blank = ~reset
    transition = Transition(
        reward=jnp.asarray(random.normal(size=shape) * blank, jnp.float32),
        terminated=jnp.asarray(ends & succeeds),
        truncated=jnp.asarray(ends & ~succeeds),
        metrics={
            "grasped": jnp.asarray((random.random(shape) < 0.4) & blank),
            "height": jnp.asarray(random.random(shape) * blank, jnp.float32),
        },
        info={
            "reset": jnp.asarray(reset),
            "blocked": jnp.asarray((random.random(shape) < 0.2) & blank),
            "diverged": jnp.asarray((random.random(shape) < 0.02) & blank),
        },
    )
    return transition, random.normal(size=(*shape, ACTIONS)).astype(np.float32)


def by_hand(transition: Transition, q: np.ndarray, counted: np.ndarray) -> dict[str, float]:
    t = jax.tree.map(np.asarray, transition)
    total = collections.Counter()
    for env in range(ENVS):
        if not counted[env]:
            continue
        episode, before = collections.Counter(), False
        for step in range(STEPS):
            total["diverged"] += t.info["diverged"][step, env]
            if t.info["reset"][step, env]:
                episode, before = collections.Counter(), False
                continue
            grasped = bool(t.metrics["grasped"][step, env])
            total["steps"] += 1
            total["blocked"] += t.info["blocked"][step, env]
            total["grasped_steps"] += grasped
            total["height_sum"] += t.metrics["height"][step, env]
            episode["length"] += 1
            episode["reward"] += t.reward[step, env]
            episode["max_q"] += q[step, env].max()
            episode["onsets"] += grasped and not before
            before = grasped
            success = bool(t.terminated[step, env])
            if success or t.truncated[step, env]:
                total["episodes"] += 1
                total["successes"] += success
                for name in ("length", "reward", "max_q"):
                    total[f"episode_{name}"] += episode[name]
                total["grasped_episodes"] += episode["onsets"] > 0
                total["grasped_failed_episodes"] += episode["onsets"] > 0 and not success
                total["grasped_onsets"] += episode["onsets"]
    return total


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("everyone", [True, False])
def test_counts_are_those_of_a_plain_loop(seed, everyone):
    transition, q = random_steps(seed)
    counted = np.ones(ENVS, bool)
    if not everyone:
        counted[1::2] = False
    envs = AutoResetState(env=jnp.zeros(ENVS), ended=jnp.zeros(ENVS, bool))
    episodes = init_episodes(Stub(), envs)
    assert set(episodes.now) == set(episodes.onsets) == {"grasped"}
    sums = collections.Counter()
    count = jax.jit(count_episodes)
    for step in range(STEPS):
        row = jax.tree.map(lambda x, step=step: x[step], transition)
        episodes, counts = count(episodes, row, q[step], counted)
        assert all((x.shape, x.dtype) == ((), jnp.float32) for x in counts.values())
        sums.update({name: float(x) for name, x in counts.items()})
    expected = by_hand(transition, q, counted)
    assert set(sums) >= set(expected)
    for name in sums:
        assert sums[name] == pytest.approx(expected[name], rel=1e-4, abs=1e-4), name
    assert expected["episodes"] > 10
    assert 0 < expected["grasped_failed_episodes"] < expected["grasped_episodes"]


def test_rates_and_means_by_hand():
    counts = {
        "steps": 50.0,
        "blocked": 5.0,
        "diverged": 0.0,
        "episodes": 4.0,
        "successes": 1.0,
        "episode_length": 40.0,
        "episode_reward": 10.0,
        "episode_max_q": 80.0,
        "grasped_steps": 20.0,
        "grasped_episodes": 3.0,
        "grasped_failed_episodes": 2.0,
        "grasped_onsets": 6.0,
        "height_sum": 25.0,
    }
    assert means(counts) == {
        "success_rate": 0.25,
        "mean_length": 10.0,
        "mean_reward": 0.25,
        "mean_max_q": 2.0,
        "blocked_share": 0.1,
        "grasped_share": 0.4,
        "grasped_rate": 0.75,
        "grasped_failed_rate": 0.5,
        "mean_height": 0.5,
    }
    nothing = means(dict.fromkeys(counts, 0.0))
    assert all(math.isnan(value) for value in nothing.values())
