from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjx_arm
from mjx_arm.training.evaluate import (
    evaluate,
    make_evaluator,
    newcombe_interval,
    wilson_interval,
)

EPISODES = 1000
# The waist is uniform within 20 degrees; beyond 10 the fake policy lifts.
RATE = 0.25
THRESHOLD = np.deg2rad(10.0)
SHOULDER_UP, OPEN, NUM_ACTIONS = 2, 12, 14


def fake_policy(params, obs):
    """Lifts the cube, within about 30 steps, or drops it and waits for the truncation."""
    del params
    action = jnp.where(obs[:, 0] > THRESHOLD, SHOULDER_UP, OPEN)
    return jax.nn.one_hot(action, NUM_ACTIONS)


@pytest.fixture(scope="module")
def env():
    return mjx_arm.make(
        "B", physics="native", observation="state", start="in_grasp", lift=0.1, max_steps=120
    )


def test_a_policy_of_known_rate_gets_its_rate(env):
    result = evaluate(env, fake_policy, None, episodes=EPISODES, epsilon=0.0, key=jax.random.key(3))
    assert result.episodes == EPISODES
    assert result.rate == result.successes / EPISODES
    # Four standard errors. Successes take a third as long as failures, so that the first thousand
    # episodes to finish would show about one half.
    assert result.rate == pytest.approx(RATE, abs=4 * np.sqrt(RATE * (1 - RATE) / EPISODES))
    assert result.ci95[0] < RATE < result.ci95[1]
    # Who opens at once never holds the cube.
    assert result.metrics["grasped_rate"] == result.rate
    assert result.metrics["grasped_failed_rate"] == 0.0
    assert 60 < result.mean_length < 120


def test_two_seeds_give_two_results_of_episodes_that_do_not_divide_evenly(env):
    evaluate_params = make_evaluator(env, fake_policy, episodes=207, epsilon=0.5)
    results = [evaluate_params(None, jax.random.key(seed)) for seed in (1, 1, 2)]
    assert [result.episodes for result in results] == [207] * 3
    assert results[0] == results[1]
    assert results[0] != results[2]


def test_wilson_interval_by_hand():
    # 8 of 10, from Wilson's formula worked out by hand.
    assert wilson_interval(8, 10) == pytest.approx((0.4902, 0.9433), abs=1e-4)
    assert wilson_interval(0, 10)[0] == 0.0
    assert wilson_interval(10, 10)[1] == 1.0


def test_newcombe_interval_is_that_of_the_paper():
    # Newcombe 1998, table II, method 10.
    assert newcombe_interval(56, 70, 48, 80) == pytest.approx((0.0524, 0.3339), abs=1e-4)
    assert newcombe_interval(9, 10, 3, 10) == pytest.approx((0.1705, 0.8090), abs=1e-4)
    assert newcombe_interval(5, 56, 0, 29) == pytest.approx((-0.0381, 0.1926), abs=1e-4)


@pytest.mark.parametrize(("option", "value"), [("episodes", 0), ("epsilon", 1.5)])
def test_bad_options_are_rejected(env, option, value):
    options = {"episodes": 1, "epsilon": 0.1, option: value}
    with pytest.raises(ValueError, match=option):
        evaluate(env, fake_policy, None, key=jax.random.key(0), **options)
