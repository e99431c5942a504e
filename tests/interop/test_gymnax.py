from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

pytestmark = pytest.mark.peers

GAMMA, LIFT = 0.99, 0.2
OPTIONS = {"physics": "native", "observation": "state"}


@pytest.fixture(scope="module")
def gymnax_env():
    from mjx_arm.interop import gymnax_env

    return gymnax_env


def test_six_values_and_the_true_last_observation(gymnax_env):
    env = gymnax_env.GymnaxEnv("A", max_steps=3, **OPTIONS)
    params = env.default_params
    first, state = env.reset(jax.random.key(0), params)
    for step in range(3):
        obs, state, reward, terminated, truncated, info = env.step(
            jax.random.key(step), state, 2, params
        )
    assert reward.dtype == jnp.float32
    assert (bool(terminated), bool(truncated)) == (False, True)
    np.testing.assert_allclose(obs, first, atol=1e-6)
    assert np.abs(info["final_observation"] - first).max() > 1e-3
    assert int(state.step) == 0


def test_the_length_of_episodes_is_a_parameter(gymnax_env):
    env = gymnax_env.GymnaxEnv("A", **OPTIONS)
    params = env.default_params.replace(max_steps_in_episode=2)
    _, state = env.reset(jax.random.key(0), params)
    assert _truncated(env, state, params, 4) == [False, True, False, True]


def test_episodes_may_be_longer_than_their_configuration(gymnax_env):
    env = gymnax_env.GymnaxEnv("A", max_steps=2, **OPTIONS)
    params = env.default_params.replace(max_steps_in_episode=4)
    _, state = env.reset(jax.random.key(0), params)
    assert _truncated(env, state, params, 4) == [False, False, False, True]


def _truncated(env, state, params, steps):
    flags = []
    for step in range(steps):
        _, state, *_, truncated, _ = env.step(jax.random.key(step), state, 2, params)
        flags.append(bool(truncated))
    return flags


def test_spaces_are_gymnaxs(gymnax_env):
    from gymnax.environments import environment, spaces

    env = gymnax_env.GymnaxEnv("B", **OPTIONS)
    assert isinstance(env, environment.Environment)
    assert isinstance(env.action_space(env.default_params), spaces.Discrete)
    obs, _ = env.reset(jax.random.key(0))
    space = env.observation_space(env.default_params)
    assert space.shape == obs.shape
    assert space.dtype == obs.dtype
    with pytest.raises(ValueError, match="rgbd"):
        gymnax_env.GymnaxEnv("A", observation="rgbd", physics="native")


def progress(before, after, action):
    """`gamma * potential(after) - potential(before)`: every way to success sums to the same."""
    del action

    def potential(snapshot):
        measured = snapshot.measured
        left = LIFT - jnp.clip(measured["height"], 0.0, LIFT)
        to_lift = 160.0 * jnp.where(measured["grasped"], left, LIFT)
        to_grasp = 20.0 + 160.0 * measured["distance"]
        return GAMMA ** (to_lift + jnp.where(measured["grasped"], 0.0, to_grasp))

    success = after.measured["success"]
    gained = jnp.where(success, 0.0, GAMMA * potential(after))
    return {
        "progress": 100.0 * (gained - potential(before)),
        "success": jnp.where(success, 100.0, 0.0),
    }


# Its own imports are behind the times.
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_rejax_learns_to_lift_a_held_cube(gymnax_env):
    """Rejax as it comes from the index; its DQN knows nothing of us."""
    import rejax

    env = gymnax_env.ClassicGymnaxEnv(
        "A", start="in_grasp", lift=LIFT, max_steps=60, reward=progress, reward_scale=0.1, **OPTIONS
    )
    agent = rejax.get_algo("dqn").create(
        env=env,
        total_timesteps=60_000,
        eval_freq=30_000,
        num_envs=10,
        buffer_size=20_000,
        fill_buffer=2_000,
        batch_size=64,
        learning_rate=5e-4,
        target_update_freq=200,
        gamma=GAMMA,
    )
    # Our tests promote types strictly; others' code does not.
    with jax.numpy_dtype_promotion("standard"):
        _, (lengths, _) = jax.jit(agent.train)(jax.random.key(1))
    # Ten steps lift it, 60 end an episode without success.
    assert lengths[0].mean() > 50
    assert lengths[-1].mean() < 20
