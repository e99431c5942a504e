"""Ends of episodes, after gymnax's test of terminal states."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjx_arm

MAX_STEPS = 3
LIFT_STEPS = 40
UP = 2


@pytest.fixture(scope="module")
def short():
    return mjx_arm.make("B", physics="native", observation="state", max_steps=MAX_STEPS)


def lifting(placement: str) -> mjx_arm.Env:
    """Succeeds within some steps of the shoulder."""
    return mjx_arm.make(
        "B",
        physics="native",
        observation="state",
        start="in_grasp",
        joint_noise=0.0,
        lift=0.2,
        placement=placement,
    )


def test_next_step_keeps_the_last_frame_and_then_resets(short):
    auto = mjx_arm.AutoReset(short, "next_step")
    step = jax.jit(auto.step)
    obs, state = jax.jit(auto.reset)(jax.random.key(0))
    for count in range(1, MAX_STEPS + 1):
        obs, state, _, terminated, truncated, info = step(jax.random.key(count), state, 3)
        assert bool(truncated) == (count == MAX_STEPS)
        assert not terminated
        assert not info["reset"]
    np.testing.assert_array_equal(obs, short.observe(state.env))
    assert state.env.step == MAX_STEPS
    fresh, state, reward, terminated, truncated, info = step(jax.random.key(9), state, 3)
    assert info["reset"]
    assert reward == 0.0
    assert not terminated
    assert not truncated
    assert state.env.step == 0
    assert (np.asarray(fresh) != np.asarray(obs)).any()
    *_, info = step(jax.random.key(10), state, 3)
    assert not info["reset"]


def test_same_step_hands_over_the_final_observation(short):
    auto = mjx_arm.AutoReset(short, "same_step")
    step = jax.jit(auto.step)
    obs, state = jax.jit(auto.reset)(jax.random.key(0))
    plain = state.env
    for count in range(1, MAX_STEPS + 1):
        obs, state, _, _, truncated, info = step(jax.random.key(count), state, 3)
        expected, plain, *_ = jax.jit(short.step)(jax.random.key(count), plain, 3)
        np.testing.assert_allclose(info["final_observation"], expected, atol=1e-6)
    assert truncated
    assert info["reset"]
    assert state.env.step == 0
    assert (np.asarray(obs) != np.asarray(info["final_observation"])).any()


def test_both_modes_keep_structure_and_dtypes(short):
    for mode in ("next_step", "same_step"):
        auto = mjx_arm.AutoReset(short, mode)
        reset = jax.eval_shape(auto.reset, jax.random.key(0))
        step = jax.eval_shape(auto.step, jax.random.key(0), reset[1], jnp.int32(0))
        assert jax.tree.map(lambda x: (x.shape, x.dtype), reset) == jax.tree.map(
            lambda x: (x.shape, x.dtype), step[:2]
        )


def test_a_reset_is_fresh(short):
    auto = mjx_arm.AutoReset(short)
    step = jax.jit(auto.step)
    _, state = jax.jit(auto.reset)(jax.random.key(0))
    starts = [state.env.physics.qpos[short.arm.qpos]]
    for count in range(3 * (MAX_STEPS + 1)):
        _, state, *_, info = step(jax.random.key(count), state, 3)
        if info["reset"]:
            starts.append(state.env.physics.qpos[short.arm.qpos])
    assert len(starts) == 4
    assert len(np.unique(np.asarray(starts), axis=0)) == 4


@pytest.mark.parametrize(
    ("placement", "after_failure", "after_success"),
    [("after_success", False, True), ("always", True, True), ("fixed", False, False)],
)
def test_the_cube_moves_when_it_should(short, placement, after_failure, after_success):
    failing = mjx_arm.make(
        "B", physics="native", observation="state", max_steps=1, placement=placement
    )
    for env, action, length, moves in (
        (failing, 3, 2, after_failure),
        (lifting(placement), UP, LIFT_STEPS, after_success),
    ):
        auto = mjx_arm.AutoReset(env)
        step = jax.jit(auto.step)
        _, state = jax.jit(auto.reset)(jax.random.key(0))
        place = np.asarray(state.env.placement)
        for count in range(length):
            _, state, _, _, _, info = step(jax.random.key(count), state, action)
            if info["reset"]:
                break
        assert info["reset"]
        assert (np.asarray(state.env.placement) != place).any() == moves


def test_unknown_mode_is_rejected(short):
    with pytest.raises(ValueError, match="unknown auto-reset mode"):
        mjx_arm.AutoReset(short, "sometimes")
