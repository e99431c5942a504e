from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_arm.algos.exploration import (
    check_epsilon,
    epsilon_at,
    epsilon_greedy,
    spread_epsilon,
)
from mjx_arm.config import ExplorationConfig, TrainConfig


def test_epsilon_is_the_share_of_random_actions():
    q = jnp.tile(jnp.asarray([0.0, 1.0, 0.0, 0.0]), (20_000, 1))
    for epsilon in (0.0, 0.4, 1.0):
        actions = np.asarray(epsilon_greedy(jax.random.key(0), q, jnp.float32(epsilon)))
        assert (actions != 1).mean() == pytest.approx(0.75 * epsilon, abs=0.02)


def test_each_environment_has_its_own_share():
    epsilon = jnp.repeat(jnp.asarray([0.0, 0.5, 1.0]), 20_000)
    q = jnp.tile(jnp.asarray([0.0, 1.0]), (60_000, 1))
    random = np.asarray(epsilon_greedy(jax.random.key(0), q, epsilon) != 1).reshape(3, -1)
    np.testing.assert_allclose(random.mean(axis=1), [0.0, 0.25, 0.5], atol=0.02)


@pytest.mark.parametrize(("steps", "expected"), [(0, 1.0), (50_000, 0.55), (100_000, 0.1)])
def test_epsilon_falls_linearly(steps, expected):
    assert epsilon_at(ExplorationConfig(), jnp.int32(steps)) == pytest.approx(expected)
    assert epsilon_at(ExplorationConfig(), jnp.int32(10 * 100_000)) == pytest.approx(0.1)


def test_environments_explore_in_equal_ratios_around_epsilon():
    config = ExplorationConfig(epsilon_spread=4.0)
    shares = np.asarray(spread_epsilon(config, jnp.float32(0.1), 5))
    np.testing.assert_allclose(shares[1:] / shares[:-1], 2.0, rtol=1e-5)
    assert shares.mean() == pytest.approx(0.1)
    assert spread_epsilon(config, jnp.float32(0.6), 5).max() == 1.0
    same = dataclasses.replace(config, epsilon_spread=1.0)
    np.testing.assert_allclose(spread_epsilon(same, jnp.float32(0.1), 5), 0.1, rtol=1e-6)
    np.testing.assert_allclose(spread_epsilon(config, jnp.float32(0.1), 1), [0.1], rtol=1e-6)


@pytest.mark.parametrize("num_envs", [1, 2, 5, 64, 4096])
@pytest.mark.parametrize("spread", [1.0, 4.0])
def test_the_mean_over_environments_is_epsilon(num_envs, spread):
    config = ExplorationConfig(epsilon_spread=spread)
    for epsilon in (0.1, 0.3):
        shares = spread_epsilon(config, jnp.float32(epsilon), num_envs)
        assert float(shares.mean()) == pytest.approx(epsilon, rel=1e-5)


@pytest.mark.parametrize(("epsilon", "mean"), [(1.0, 0.68), (0.1, 0.1)])
def test_the_mean_share_of_the_defaults_is_as_documented(epsilon, mean):
    """Shares above 1 are cut, so that the mean is below epsilon at the beginning."""
    config = TrainConfig()
    ends = (config.exploration.epsilon_start, config.exploration.epsilon_end)
    assert epsilon in ends
    shares = spread_epsilon(config.exploration, jnp.float32(epsilon), config.num_envs)
    assert float(shares.mean()) == pytest.approx(mean, abs=0.005)
    assert (float(shares.max()) == 1.0) == (epsilon == 1.0)


@pytest.mark.parametrize("epsilon", [-0.1, 1.1, float("nan")])
def test_what_is_no_share_is_rejected(epsilon):
    with pytest.raises(ValueError, match="epsilon must be a finite number from 0 to 1, got"):
        check_epsilon(epsilon)
