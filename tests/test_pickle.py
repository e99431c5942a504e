"""An environment comes out of a pickle as it went in."""

from __future__ import annotations

import pickle

import jax.numpy as jnp
import pytest

import mjx_arm


def own_reward(before, after, action):
    return {"moved": jnp.abs(after.state.ctrl - before.state.ctrl).sum()}


@pytest.mark.parametrize("reward", ["", own_reward])
def test_an_environment_can_be_pickled(reward):
    env = mjx_arm.make("A", reward=reward, size=(16, 16), physics="native")
    back = pickle.loads(pickle.dumps(env))
    assert back.config == env.config
    assert back.scene.source == env.scene.source
    assert (back.reward is own_reward) == (reward is own_reward)
    assert (back.num_actions, back.feature_scales) == (env.num_actions, env.feature_scales)


def test_a_reward_that_no_process_could_import_is_named():
    env = mjx_arm.make("A", reward=lambda *_: {"none": jnp.zeros(())}, physics="native")
    with pytest.raises((pickle.PicklingError, AttributeError), match="lambda"):
        pickle.dumps(env)
