"""The ring against a plain Python list, over borders of episodes and of the ring."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_arm.algos.replay import Step, add, init_replay, sample, sample_frames

SLOTS, ENVS, GAMMA = 16, 3, 0.9


def make_step(time: int, *, terminated=(), truncated=(), masked=()) -> Step:
    """Frame and reward say which slot they are of: 100 * environment + time."""

    def flags(which) -> jax.Array:
        return jnp.asarray([(time, env) in which for env in range(ENVS)])

    frame = jnp.asarray([100 * env + time for env in range(ENVS)], jnp.float32)
    return Step(
        frame=frame,
        action=jnp.full(ENVS, time % 14, jnp.uint8),
        reward=frame,
        terminated=flags(terminated),
        truncated=flags(truncated),
        masked=flags(masked),
    )


def filled(length: int, **flags):
    replay = init_replay(make_step(0), SLOTS)
    for time in range(length):
        replay = add(replay, make_step(time, **flags))
    return replay


@pytest.mark.parametrize("n_step", [1, 3])
@pytest.mark.parametrize("length", [9, SLOTS, 3 * SLOTS + 5])
def test_samples_are_n_step_transitions(n_step, length):
    replay = filled(length)
    batch = sample(replay, jax.random.key(0), 2000, n_step, GAMMA)
    env, time = np.divmod(np.asarray(batch.frame, int), 100)
    expected = sum(GAMMA**k * (100 * env + time + k) for k in range(n_step))
    np.testing.assert_allclose(batch.reward, expected, rtol=1e-5)
    np.testing.assert_array_equal(batch.next_frame, batch.frame + n_step)
    np.testing.assert_array_equal(batch.action, time % 14)
    np.testing.assert_allclose(batch.discount, GAMMA**n_step, rtol=1e-6)
    assert (np.asarray(batch.weight) == 1.0).all()
    oldest = max(0, length - SLOTS)
    assert set(time) == set(range(oldest, length - n_step))
    assert set(env) == set(range(ENVS))


def test_a_termination_ends_the_sum_and_bootstraps_nothing():
    ends = {(5, 1)}
    batch = sample(filled(12, terminated=ends, masked={(6, 1)}), jax.random.key(1), 4000, 3, GAMMA)
    for start, expected in ((3, 103 + 0.9 * 104 + 0.81 * 105), (4, 104 + 0.9 * 105), (5, 105)):
        rows = np.flatnonzero(np.asarray(batch.frame) == 100 + start)
        assert len(rows) > 0
        np.testing.assert_allclose(np.asarray(batch.reward)[rows], expected, rtol=1e-5)
        np.testing.assert_array_equal(np.asarray(batch.discount)[rows], 0.0)
        np.testing.assert_array_equal(np.asarray(batch.weight)[rows], 1.0)


def test_a_truncation_bootstraps_from_the_true_last_frame():
    batch = sample(
        filled(12, truncated={(5, 1)}, masked={(6, 1)}), jax.random.key(1), 4000, 3, GAMMA
    )
    for start, length in ((3, 3), (4, 2), (5, 1)):
        rows = np.flatnonzero(np.asarray(batch.frame) == 100 + start)
        np.testing.assert_array_equal(np.asarray(batch.next_frame)[rows], 106)
        np.testing.assert_allclose(np.asarray(batch.discount)[rows], GAMMA**length, rtol=1e-6)


def test_no_transition_crosses_the_border_of_an_episode():
    batch = sample(
        filled(12, truncated={(5, 1)}, masked={(6, 1)}), jax.random.key(1), 4000, 3, GAMMA
    )
    weight = np.asarray(batch.weight)
    frame = np.asarray(batch.frame)
    assert (weight[frame == 106] == 0.0).all()
    assert (weight[frame != 106] == 1.0).all()


def test_a_diverged_step_reaches_no_transition():
    batch = sample(
        filled(12, truncated={(5, 1)}, masked={(5, 1), (6, 1)}), jax.random.key(1), 4000, 3, GAMMA
    )
    frame, weight = np.asarray(batch.frame), np.asarray(batch.weight)
    for start in (3, 4, 5, 6):
        assert (weight[frame == 100 + start] == 0.0).all()
    assert (weight[frame == 102] == 1.0).all()


def test_adding_writes_in_place():
    replay = filled(3)
    compiled = jax.jit(add, donate_argnums=0).lower(replay, make_step(3)).compile()
    assert compiled.memory_analysis().alias_size_in_bytes >= replay.steps.reward.nbytes


@pytest.mark.parametrize("length", [1, 9, 3 * SLOTS + 5])
def test_sampled_frames_are_all_that_the_ring_holds(length):
    frames = np.asarray(sample_frames(filled(length), jax.random.key(0), 2000), int)
    times = range(max(0, length - SLOTS), length)
    assert set(frames) == {100 * env + time for env in range(ENVS) for time in times}
