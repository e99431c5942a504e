from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from mjx_arm.algos.dqn import QLearning, td_error, td_target
from mjx_arm.algos.replay import Batch, Step, add, init_replay, sample

GAMMA = 0.9


def test_target_and_error_by_hand():
    next_q, chooser = jnp.asarray([1.0, 5.0, 3.0]), jnp.asarray([0.0, 1.0, 2.0])
    assert td_target(jnp.float32(2.0), jnp.float32(0.5), next_q, next_q) == 4.5
    assert td_target(jnp.float32(2.0), jnp.float32(0.5), next_q, chooser) == 3.5
    assert td_target(jnp.float32(2.0), jnp.float32(0.0), next_q, chooser) == 2.0
    assert td_error(jnp.asarray([7.0, 8.0]), jnp.int32(1), jnp.float32(3.0)) == 5.0


@pytest.mark.parametrize(
    ("error", "expected", "square"), [(0.5, 0.125, 0.125), (-1.0, 0.5, 0.5), (3.0, 2.5, 4.5)]
)
def test_losses_by_hand(error, expected, square):
    q = jnp.asarray([[1.0, 1.0 + error], [0.0, 0.0]])
    batch = Batch(
        frame=jnp.zeros(1),
        next_frame=jnp.ones(1),
        action=jnp.asarray([1]),
        reward=jnp.asarray([1.0]),
        discount=jnp.asarray([GAMMA]),
        weight=jnp.asarray([1.0]),
    )
    for huber, loss in ((True, expected), (False, square)):
        learning = dataclasses.replace(make_tabular(), huber=huber)
        learner = dataclasses.replace(learning.init(jax.random.key(0), None), params=q)
        learner = dataclasses.replace(learner, target_params=q)
        _, metrics = learning.update(learner, batch, batch.frame, batch.next_frame)
        assert metrics["loss"] == pytest.approx(loss)


def test_a_masked_transition_with_nan_changes_nothing():
    """Zero times NaN is NaN, so that a weight of 0 alone would not do."""
    learning = dataclasses.replace(make_tabular(), apply=lambda params, obs: obs[:, None] * params)
    learner = learning.init(jax.random.key(0), None)
    learner = dataclasses.replace(
        learner, params=jnp.asarray([0.3, -0.2]), target_params=jnp.asarray([0.1, 0.2])
    )
    learner = dataclasses.replace(learner, opt_state=learning.optimizer.init(learner.params))

    def after(bad: float):
        batch = Batch(
            frame=jnp.asarray([1.0, bad]),
            next_frame=jnp.asarray([0.5, bad]),
            action=jnp.asarray([1, 0]),
            reward=jnp.asarray([1.0, 0.0]),
            discount=jnp.asarray([GAMMA, 0.0]),
            weight=jnp.asarray([1.0, 0.0]),
        )
        return learning.update(learner, batch, batch.frame, batch.next_frame)

    for one, other in zip(*map(jax.tree.leaves, (after(jnp.nan), after(0.0))), strict=True):
        assert np.isfinite(one).all()
        np.testing.assert_array_equal(one, other)


def test_ranks_are_asserted():
    with pytest.raises(AssertionError):
        td_target(jnp.zeros(2), jnp.zeros(()), jnp.zeros(3), jnp.zeros(3))


def test_an_update_in_microbatches_is_an_update():
    dqn = make_tabular(polyak=0.05)
    learner = dqn.init(jax.random.key(0), jnp.zeros(1))
    learner = dataclasses.replace(learner, target_params=learner.params + 1.0)
    keys = iter(jax.random.split(jax.random.key(1), 8))
    obs, next_obs = jax.random.randint(next(keys), (2, 32), 0, 2).astype(jnp.float32)
    batch = Batch(
        frame=obs,
        next_frame=next_obs,
        action=jax.random.randint(next(keys), (32,), 0, 2),
        reward=jax.random.normal(next(keys), (32,)),
        discount=jax.random.uniform(next(keys), (32,)),
        weight=jax.random.bernoulli(next(keys), 0.8, (32,)).astype(jnp.float32),
    )
    whole, parts = (
        dataclasses.replace(dqn, microbatches=n).update(learner, batch, obs, next_obs)
        for n in (1, 4)
    )
    for one, other in zip(jax.tree.leaves(whole), jax.tree.leaves(parts), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-6)


def make_tabular(polyak=0.0, target_period=20, double=True) -> QLearning:
    """Q-values of two observations, 0 and 1, and two actions, from a table."""

    def apply(params, obs):
        return params[obs.astype(jnp.int32)]

    return QLearning(
        apply=apply,
        init_params=lambda key, obs: 0.1 * jax.random.normal(key, (2, 2)),
        optimizer=optax.adam(0.05),
        double=double,
        huber=True,
        polyak=polyak,
        target_period=target_period,
    )


def probe(transition, *, n_step: int, dqn: QLearning, length: int = 100) -> np.ndarray:
    """Learns the Q-values of a probe: `transition(obs, action) -> next, reward, end, cut`."""
    rng = np.random.default_rng(0)
    obs, over, replay = 0, False, None
    for _ in range(length):
        action = int(rng.integers(2))
        if over:
            after, reward, end, cut, masked = 0, 0.0, False, False, True
        else:
            (after, reward, end, cut), masked = transition(obs, action), False
        step = Step(
            frame=jnp.asarray([obs], jnp.float32),
            action=jnp.asarray([action], jnp.uint8),
            reward=jnp.asarray([reward], jnp.float32),
            terminated=jnp.asarray([end]),
            truncated=jnp.asarray([cut]),
            masked=jnp.asarray([masked]),
        )
        # 64 slots hold less than was written, so that the ring has wrapped around.
        replay = add(init_replay(step, 64) if replay is None else replay, step)
        obs, over = after, end or cut

    def learn(learner, key):
        batch = sample(replay, key, 32, n_step, GAMMA)
        return dqn.update(learner, batch, batch.frame, batch.next_frame)

    learner = dqn.init(jax.random.key(0), jnp.zeros(1))
    keys = jax.random.split(jax.random.key(1), 2000)
    learner, _ = jax.jit(lambda s, k: jax.lax.scan(learn, s, k))(learner, keys)
    return np.asarray(learner.params)


DQNS = {
    "copies": make_tabular(),
    "polyak": make_tabular(polyak=0.05),
    "single": make_tabular(double=False),
}


@pytest.mark.parametrize("dqn", DQNS.values(), ids=DQNS.keys())
@pytest.mark.parametrize("n_step", [1, 3])
class TestProbes:
    """Environments with known Q-values, each one notch harder."""

    def test_constant_reward(self, dqn, n_step):
        q = probe(lambda obs, action: (0, 1.0, True, False), n_step=n_step, dqn=dqn)
        np.testing.assert_allclose(q[0], [1.0, 1.0], atol=0.02)

    def test_reward_by_observation(self, dqn, n_step):
        def transition(obs, action):
            return (1, -1.0, False, False) if obs == 0 else (0, 2.0, True, False)

        q = probe(transition, n_step=n_step, dqn=dqn)
        np.testing.assert_allclose(q, [[-1.0 + 2 * GAMMA] * 2, [2.0, 2.0]], atol=0.04)

    def test_delayed_reward(self, dqn, n_step):
        def transition(obs, action):
            return (1, 0.0, False, False) if obs == 0 else (0, 1.0, True, False)

        q = probe(transition, n_step=n_step, dqn=dqn)
        np.testing.assert_allclose(q, [[GAMMA, GAMMA], [1.0, 1.0]], atol=0.03)

    def test_reward_by_action(self, dqn, n_step):
        q = probe(
            lambda obs, action: (0, 1.0 if action else -1.0, True, False), n_step=n_step, dqn=dqn
        )
        np.testing.assert_allclose(q[0], [-1.0, 1.0], atol=0.03)

    def test_truncation_bootstraps_for_ever(self, dqn, n_step):
        q = probe(lambda obs, action: (0, 1.0, False, True), n_step=n_step, dqn=dqn)
        np.testing.assert_allclose(q[0], [10.0, 10.0], atol=0.5)
