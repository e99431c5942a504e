from __future__ import annotations

import dataclasses

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from mjx_arm.algos import distill
from mjx_arm.algos.distill import Distill, Student, advantage_spread, imitation_loss
from mjx_arm.algos.dqn import QLearning
from mjx_arm.algos.frames import Frames
from mjx_arm.algos.replay import sample
from mjx_arm.config import DistillConfig, TrainConfig, set_train_options, train_config
from mjx_arm.envs.env import make_env
from mjx_arm.training.algorithm import make_teacher
from mjx_arm.training.loop import (
    Trainer,
    make_body,
    make_train,
    make_trainer,
    run_keys,
    summarise,
)

CONFIG = train_config(
    algorithm="distill",
    physics="native",
    num_envs=4,
    size=(16, 16),
    replay_size=400,
    learning_starts=40,
    chunk_steps=80,
    max_steps=15,
    widths=(4, 4, 4),
    hidden=16,
    n_step=2,
    teacher_batch_size=16,
    teacher_hidden=16,
    student_starts=80,
    student_batch_size=8,
    student_updates_per_step=2,
    # 16 images in each of the 20 steps of a chunk: it drives a chunk after its first update.
    student_warm_up=320,
)
# Vector steps of 80 environment steps.
CHUNK = CONFIG.chunk_length


def with_options(config: TrainConfig, **values) -> TrainConfig:
    return set_train_options(config, values)


def numpy_bits(tree):
    return [
        np.asarray(jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x)
        for x in jax.tree.leaves(tree)
    ]


def differs(one, other) -> bool:
    pairs = zip(*map(jax.tree.leaves, (one, other)), strict=True)
    return all((np.asarray(a) != np.asarray(b)).any() for a, b in pairs)


def equal(one, other) -> bool:
    pairs = zip(numpy_bits(one), numpy_bits(other), strict=True)
    return all(np.array_equal(a, b) for a, b in pairs)


# The loss, by hand.


def test_loss_by_hand():
    q, target = np.asarray([0.0, 1.0, 2.0]), np.asarray([1.0, 1.0, 4.0])
    temperature = 0.5
    logits, wanted = (x / temperature for x in (q - 1.0, target - 2.0))
    share = np.exp(wanted) / np.exp(wanted).sum()
    log = logits - np.log(np.exp(logits).sum())
    expected = -(share * log).sum() + 0.1 * (1.0 - 2.0) ** 2
    actual = imitation_loss(
        jnp.asarray(q, jnp.float32), jnp.asarray(target, jnp.float32), jnp.float32(temperature)
    )
    assert float(actual) == pytest.approx(expected, rel=1e-5)


def test_loss_of_two_actions_by_hand():
    # Advantages of plus and minus one half; cross-entropy of a share of sigmoid(2) with itself.
    q = jnp.asarray([1.0, 0.0])
    share = 1 / (1 + np.exp(-2.0))
    expected = -(share * np.log(share) + (1 - share) * np.log(1 - share))
    assert float(imitation_loss(q, q, jnp.float32(0.5))) == pytest.approx(expected, rel=1e-5)
    # Three more for all actions: the softmax does not see it, a tenth of its square does.
    shifted = imitation_loss(q + 3.0, q, jnp.float32(0.5))
    assert float(shifted) == pytest.approx(expected + 0.9, rel=1e-5)


def test_loss_is_least_at_the_target():
    target = jnp.asarray([0.3, -0.2, 0.5, 0.1])
    gradient = jax.grad(imitation_loss)(target, target, jnp.float32(0.2))
    np.testing.assert_allclose(gradient, 0.0, atol=1e-5)
    for axis in range(4):
        for change in (-0.1, 0.1):
            other = target.at[axis].add(change)
            loss = imitation_loss(other, target, jnp.float32(0.2))
            assert loss > imitation_loss(target, target, jnp.float32(0.2))


def test_the_spread_of_each_state_by_hand():
    target = jnp.asarray([[0.0, 3.0, -3.0], [5.0, 5.3, 4.7], [1.0, 1.0, 1.0]])
    # Between a tenth of the mean of all states and that mean.
    expected = [1.0, np.sqrt(0.06), 0.1]
    np.testing.assert_allclose(advantage_spread(target, jnp.float32(1.0)), expected, rtol=1e-5)


def test_a_state_of_small_advantages_weighs_as_much_as_one_of_large_ones():
    """The loss of a student that prefers nothing is the same in both."""
    toy = make_toy()
    student = toy_student(toy)
    obs = jnp.zeros((1, 4))  # the bias alone answers: equal Q-values
    large = jnp.asarray([[1.0, 0.0, -1.0]])
    losses = [
        float(toy.imitate(student, obs, scale * large)[1]["student_loss"]) for scale in (1.0, 0.1)
    ]
    assert losses[0] == pytest.approx(losses[1], rel=1e-3)


def test_ranks_are_asserted():
    with pytest.raises(AssertionError):
        imitation_loss(jnp.zeros((2, 3)), jnp.zeros(3), jnp.zeros(()))


# The algorithm, without an environment.


class Linear(nn.Module):
    num_actions: int = 3

    @nn.compact
    def __call__(self, obs):
        return nn.Dense(self.num_actions)(obs)


def make_toy(num_envs=8, **options) -> Distill:
    def features(frame):
        return frame["features"]

    frames = Frames(lambda envs: envs, lambda envs, obs: obs, lambda frame: frame["obs"], features)
    teacher = QLearning(
        apply=lambda params, x: x @ params,
        init_params=lambda key, x: jax.random.normal(key, (x.shape[-1], 3)),
        optimizer=optax.adam(1e-3),
        double=True,
        huber=True,
        polyak=0.01,
        target_period=1,
    )
    return Distill(DistillConfig(**options), frames, teacher, Linear(), num_envs)


def toy_student(toy: Distill) -> Student:
    frame = {"obs": jnp.zeros((1, 4)), "features": jnp.zeros((1, 2))}
    return toy.init(jax.random.key(0), frame["obs"], frame).student


def test_updates_move_the_student_to_the_teacher():
    toy = make_toy(student_learning_rate=0.02)
    obs = jax.random.normal(jax.random.key(1), (64, 4))
    target = obs @ jax.random.normal(jax.random.key(2), (4, 3))
    student, rows = toy_student(toy), []
    update = jax.jit(toy.imitate)
    for _ in range(600):
        student, metrics = update(student, obs, target)
        rows.append({name: float(x) for name, x in metrics.items()})
    assert rows[-1]["student_loss"] < rows[0]["student_loss"]
    assert rows[0]["student_agreement"] < 0.8 < 0.97 < rows[-1]["student_agreement"]
    # The parameters that act are averaged: they follow.
    assert differs(student.params, student.averaged)
    chosen = jnp.argmax(toy.apply(student.averaged, obs), axis=-1)
    assert float(jnp.mean(chosen == jnp.argmax(target, axis=-1))) > 0.95


def test_the_students_learning_rate_falls_by_a_cosine():
    # 40 environment steps of 8 environments, 2 updates each: 10 updates.
    toy = make_toy(student_learning_rate=0.02, student_decay_steps=40, student_updates_per_step=2)
    plain = make_toy(student_learning_rate=0.02)
    obs = jax.random.normal(jax.random.key(1), (8, 4))
    target = 100.0 * jax.random.normal(jax.random.key(2), (8, 3))
    falling, steady = toy_student(toy), toy_student(plain)

    def change(before: Student, after: Student) -> float:
        gaps = jax.tree.map(lambda a, b: jnp.max(jnp.abs(a - b)), before.params, after.params)
        return max(float(x) for x in jax.tree.leaves(gaps))

    for update in range(12):
        # The same gradients and moments: the two steps differ by the rate alone.
        start = dataclasses.replace(falling, params=steady.params, averaged=steady.averaged)
        falling, _ = toy.imitate(start, obs, target)
        after, _ = plain.imitate(steady, obs, target)
        share = 0.05 + 0.95 * 0.5 * (1 + np.cos(np.pi * min(update, 10) / 10))
        assert change(start, falling) == pytest.approx(share * change(steady, after), rel=1e-3)
        steady = after


def test_the_spread_follows_the_teachers_advantages():
    toy = make_toy()
    student = toy_student(toy)
    assert float(student.spread) == pytest.approx(0.05)
    target = jnp.asarray([[0.0, 1.0, -1.0], [2.0, 2.0, 2.0]])
    after, _ = toy.imitate(student, jnp.zeros((2, 4)), target)
    # Root mean square of 0, 1, -1, 0, 0, 0, averaged over 1,000 updates.
    assert float(after.spread) == pytest.approx(0.999 * 0.05 + 0.001 * np.sqrt(1 / 3), rel=1e-5)


def test_microbatches_give_the_update_of_the_whole_batch(monkeypatch):
    toy = make_toy()
    obs = jax.random.normal(jax.random.key(1), (64, 4))
    target = jax.random.normal(jax.random.key(2), (64, 3))
    results = []
    for parts in (1, 4):
        monkeypatch.setattr(distill, "num_microbatches", lambda size, parts=parts: parts)
        results.append(toy.imitate(toy_student(toy), obs, target))
    for one, other in zip(*map(jax.tree.leaves, results), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize(
    ("share", "num_envs", "driven"),
    [
        (0.5, 8, [1, 3, 5, 7]),
        (0.0, 8, []),
        (1.0, 8, list(range(8))),
        (0.25, 8, [3, 7]),
        (0.5, 1, []),
        (0.3, 5, [2, 4]),
    ],
)
def test_the_student_drives_its_share_evenly(share, num_envs, driven):
    toy = make_toy(num_envs, student_share=share, student_starts=100)
    images = toy.config.student_batch_size * toy.config.student_updates_per_step
    # The student learns from these images in 80 environment steps.
    toy = dataclasses.replace(
        toy, config=dataclasses.replace(toy.config, student_warm_up=80 // num_envs * images)
    )
    frame = {"obs": jnp.ones((num_envs, 4)), "features": jnp.ones((num_envs, 2))}
    pair = toy.init(jax.random.key(0), frame["obs"][:1], jax.tree.map(lambda x: x[:1], frame))
    of_teacher = toy.teacher.apply(pair.teacher.params, frame["features"])
    of_student = toy.apply(pair.student.averaged, frame["obs"])
    for env_steps, mine in ((0, []), (179, []), (180, driven), (10**6, driven)):
        q = toy.q_values(pair, frame["obs"], frame, jnp.int32(env_steps))
        by_student = np.flatnonzero((np.asarray(q) == np.asarray(of_student)).all(axis=-1))
        by_teacher = np.flatnonzero((np.asarray(q) == np.asarray(of_teacher)).all(axis=-1))
        assert by_student.tolist() == mine
        assert sorted([*by_student, *by_teacher]) == list(range(num_envs))
        assert bool(toy.acts_on_obs(jnp.int32(env_steps))) == (env_steps >= 180)


def test_a_policy_to_start_from_is_the_students():
    toy = make_toy()
    frame = {"obs": jnp.zeros((1, 4)), "features": jnp.zeros((1, 2))}
    pair = toy.init(jax.random.key(0), frame["obs"], frame)
    params = jax.tree.map(lambda x: x + 1.0, toy.policy(pair))
    after = toy.with_policy(pair, params)
    assert equal(toy.policy(after), params)
    assert equal(after.student.params, params)
    assert equal(after.teacher, pair.teacher)


# A tiny run.


def run_chunks(trainer: Trainer, state, chunks: range):
    rows = []
    for chunk in chunks:
        state, counts = trainer.run_chunk(state)
        step = (chunk + 1) * trainer.config.chunk_length
        rows.append(summarise(trainer.config, trainer.algorithm, jax.device_get(counts), step))
    return state, rows


@pytest.fixture(scope="module")
def run():
    """Four chunks: nobody drives in the first two, the student drives from the third on."""
    trainer = make_trainer(CONFIG)
    states, rows = [trainer.init(run_keys(CONFIG))], []
    for chunk in range(4):
        # A chunk donates its argument.
        copy = jax.tree.map(jnp.copy, states[-1])
        state, row = run_chunks(trainer, copy, range(chunk, chunk + 1))
        states.append(state)
        rows += row
    assert trainer.run_chunk._cache_size() == 1
    return trainer, states, rows


def test_the_teacher_learns_before_the_student_starts(run):
    _, states, rows = run
    assert 0 < rows[0]["updates"] < CHUNK == rows[1]["updates"]
    # Before the step that completes 80 steps of the environments there are none.
    assert rows[0]["student_updates"] == 0
    assert rows[1]["student_updates"] == 2 * CHUNK
    assert np.isnan(rows[0]["student_loss"])
    assert all(np.isfinite(row["student_loss"]) for row in rows[1:])
    learners = [state.learner for state in states]
    assert differs(learners[0].teacher.params, learners[1].teacher.params)
    assert equal(learners[0].student, learners[1].student)
    assert differs(learners[1].student.params, learners[2].student.params)
    assert differs(learners[1].student.averaged, learners[2].student.averaged)


def test_the_teacher_may_have_several_updates_in_a_step(run):
    """Two updates of a step are those of two calls with one update each, with the same keys."""
    trainer, states, _ = run
    several = make_trainer(with_options(CONFIG, teacher_updates_per_step=2)).algorithm
    key, replay, steps = jax.random.key(5), states[2].replay, jnp.int32(0)
    pair, counts = jax.jit(several.learn)(key, states[2].learner, replay, steps)
    assert counts["updates"] == 2
    one = trainer.algorithm
    keys = jax.random.split(jax.random.split(key)[0], 2)
    config, frames = CONFIG.algo, one.frames
    expected = states[2].learner.teacher
    for each in keys:
        batch = sample(replay, each, config.teacher_batch_size, config.n_step, config.gamma)
        features = (frames.features(batch.frame), frames.features(batch.next_frame))
        expected = one.teacher.update(expected, batch, *features)[0]
    for leaf, other in zip(*map(jax.tree.leaves, (pair.teacher, expected)), strict=True):
        np.testing.assert_allclose(leaf, other, rtol=1e-5, atol=1e-6)
    twice = with_options(CONFIG, teacher_updates_per_step=2)
    assert twice.samples_per_step == 2 * CONFIG.samples_per_step


@pytest.mark.parametrize(
    ("num_envs", "batch", "updates", "steps"), [(64, 64, 3, 1_563), (4_096, 512, 8, 74)]
)
def test_the_student_drives_after_the_same_number_of_images(num_envs, batch, updates, steps):
    config = dataclasses.replace(
        CONFIG.algo,
        student_starts=8_192,
        student_warm_up=300_000,
        student_batch_size=batch,
        student_updates_per_step=updates,
    )
    algorithm = dataclasses.replace(make_toy(num_envs=num_envs), config=config)
    first = 8_192 + steps * num_envs
    assert algorithm.acts_on_obs(first)
    assert not algorithm.acts_on_obs(first - 1)


def test_the_state_is_never_shown_to_the_student(run):
    trainer, states, _ = run
    policy = trainer.algorithm.policy(states[-1].learner)
    assert equal(policy, states[-1].learner.student.averaged)
    q = trainer.algorithm.apply(policy, states[-1].obs)
    assert (q.shape, q.dtype) == ((4, 14), jnp.float32)


def test_images_are_not_rendered_until_the_student_drives(run):
    """The carried images are those of the start until then, and afterwards what is seen now."""
    trainer, states, _ = run
    observe = jax.jit(trainer.algorithm.frames.observe)
    starts = np.asarray(states[0].obs)
    np.testing.assert_array_equal(states[1].obs, starts)
    assert (np.asarray(observe(states[1].envs)) != starts).any()
    for state in states[2:]:
        np.testing.assert_array_equal(state.obs, observe(state.envs))


def test_a_resumed_run_is_the_same_to_the_bit(run, tmp_path):
    from mjx_arm.training.checkpoint import RunCheckpoints

    trainer, states, _ = run
    checkpoints = RunCheckpoints(tmp_path)
    checkpoints.save(2 * CHUNK, states[2])
    like = jax.eval_shape(trainer.init, run_keys(CONFIG))
    again, _ = run_chunks(trainer, checkpoints.load(2 * CHUNK, like), range(2, 4))
    for one, other in zip(numpy_bits(again), numpy_bits(states[4]), strict=True):
        np.testing.assert_array_equal(one, other)


def test_both_storages_do_the_same():
    """Without an update both runs act the same, and a frame is decoded to the same image."""
    config = with_options(CONFIG, learning_starts=400)
    batches, images, features = [], [], []
    for storage in ("states", "pixels"):
        stored = with_options(config, storage=storage)
        trainer = make_trainer(stored)
        state, _ = run_chunks(trainer, trainer.init(run_keys(stored)), range(3))
        batch = sample(state.replay, jax.random.key(0), 64, 2, 0.99)
        frames = make_body(stored).algorithm.frames
        images.append(np.asarray(jax.jit(frames.decode)(batch.frame)))
        features.append(np.asarray(frames.features(batch.frame)))
        batches.append(dataclasses.replace(batch, frame=None, next_frame=None))
    for a, b in zip(*map(jax.tree.leaves, batches), strict=True):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(*features)
    # Poses by C and by our kinematics differ in the last bit, which may tip a pixel on an edge.
    assert np.mean(images[0] >> 24 != images[1] >> 24) < 2e-3


def test_seeds_side_by_side_are_the_runs_one_by_one(run):
    single, states, _ = run
    trainer = make_trainer(with_options(CONFIG, num_seeds=2))
    both = trainer.init(run_keys(trainer.config))
    for _ in range(2):
        both, counts = trainer.run_chunk(both)
    assert counts["student_updates"].shape == (2,)
    other = with_options(CONFIG, seed=1)
    alone = [states[2], run_chunks(single, single.init(run_keys(other)), range(2))[0]]
    for seed in (0, 1):
        np.testing.assert_array_equal(
            both.replay.steps.action[seed], alone[seed].replay.steps.action
        )
        # Of all parameters at once: Adam turns the rounding of one gradient near zero into a step.
        together, own, other = (
            np.concatenate([np.ravel(x).astype(float) for x in jax.tree.leaves(tree)])
            for tree in (
                jax.tree.map(lambda x, seed=seed: x[seed], both.learner),
                alone[seed].learner,
                alone[1 - seed].learner,
            )
        )
        assert np.linalg.norm(together - own) <= 0.01 * np.linalg.norm(own - other)


@pytest.mark.slow
def test_a_whole_run_is_one_function(run):
    _, states, _ = run
    total = 2 * CHUNK * CONFIG.num_envs
    final, counts = jax.jit(make_train(with_options(CONFIG, total_steps=total)))(run_keys(CONFIG))
    assert counts["student_updates"].tolist() == [0, 2 * CHUNK]
    pairs = map(jax.tree.leaves, (final.learner, states[2].learner))
    for a, b in zip(*pairs, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5)


def test_the_teacher_has_its_own_options():
    env = make_env(CONFIG.env)
    features = jnp.zeros((1, len(env.feature_scales)), jnp.float32)

    def made(**options):
        teacher = make_teacher(DistillConfig(teacher_hidden=16, **options), env)
        params = jax.eval_shape(teacher.init_params, jax.random.key(0), features)
        return teacher, str(jax.tree_util.tree_structure(params))

    usual, names = made()
    assert usual.double
    assert usual.huber
    assert names.count("LayerNorm") == 2
    assert names.count("Dense") == 4
    other, names = made(
        teacher_double=False,
        teacher_huber=False,
        teacher_dueling=False,
        teacher_layer_norm=False,
    )
    assert not other.double
    assert not other.huber
    assert "LayerNorm" not in names
    assert names.count("Dense") == 3


def test_the_largest_start_stands_for_never():
    toy = make_toy(student_starts=2**31 - 1, student_warm_up=100)
    assert not toy.acts_on_obs(jnp.int32(2**31 - 2))
