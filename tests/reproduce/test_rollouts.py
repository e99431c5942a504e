"""Recorded episodes are those that the evaluation counts."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_arm.envs.env import make
from mjx_arm.reproduce.records import summarise
from mjx_arm.reproduce.rollouts import roll_out
from mjx_arm.training.evaluate import evaluate

EPISODES, STEPS = 7, 40


@pytest.fixture(scope="module")
def env():
    # Without noise of the joints, which takes long to compile.
    return make("A", observation="state", physics="native", max_steps=STEPS, placement="always")


def apply(params, obs):
    return obs @ params


@pytest.fixture(scope="module")
def params(env):
    size = (len(env.feature_scales), env.num_actions)
    return jnp.asarray(np.random.default_rng(0).normal(size=size), jnp.float32)


@pytest.fixture(scope="module")
def rollouts(env, params):
    key = jax.random.key(5)
    return roll_out(env, apply, params, episodes=EPISODES, epsilon=0.3, key=key)


def test_they_are_the_evaluations_episodes(env, params, rollouts):
    found = evaluate(
        env, apply, params, episodes=EPISODES, epsilon=0.3, key=jax.random.key(5)
    )  # fmt: skip
    assert len(rollouts) == found.episodes
    assert sum(x.success for x in rollouts) == found.successes
    assert np.mean([len(x) for x in rollouts]) == pytest.approx(found.mean_length)
    held = np.mean([x.grasped.any() for x in rollouts])
    assert held == pytest.approx(found.metrics["grasped_rate"])


def test_an_episode_has_one_more_frame_than_steps(rollouts):
    for rollout in rollouts:
        assert len(rollout.qpos) == len(rollout) + 1
        assert len(rollout) == STEPS or rollout.success or rollout.diverged
        assert len(rollout.height) == len(rollout.grasped) == len(rollout)


def test_the_start_is_the_start(env, rollouts):
    columns = summarise(rollouts, env.arm, env.task.cube_qpos)
    assert len(columns["success"]) == EPISODES
    assert np.abs(columns["joints"]).max() == 0.0
    # Other starts for other episodes.
    assert len({tuple(x) for x in columns["cube"]}) == EPISODES
    low, high = [0.31, -0.1], [0.41, 0.1]
    assert (np.asarray(columns["cube"]) >= low).all()
    assert (np.asarray(columns["cube"]) <= high).all()


def test_random_actions_are_recorded(rollouts):
    differ = np.mean(np.concatenate([x.action != x.greedy for x in rollouts]))
    assert 0.1 < differ < 0.5


@pytest.mark.parametrize(("episodes", "epsilon"), [(0, 0.1), (1, 1.5)])
def test_bad_numbers_are_rejected(env, params, episodes, epsilon):
    with pytest.raises(ValueError, match="must be"):
        roll_out(env, apply, params, episodes=episodes, epsilon=epsilon, key=jax.random.key(0))


def test_another_task_is_rejected(params):
    env = make("A", task="reach", observation="state", physics="native")
    with pytest.raises(ValueError, match="of the task 'lift', got 'reach'"):
        roll_out(env, apply, params, episodes=1, epsilon=0.0, key=jax.random.key(0))
