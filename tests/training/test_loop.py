from __future__ import annotations

import dataclasses
import re

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjx_arm
from mjx_arm.algos.exploration import epsilon_at, spread_epsilon
from mjx_arm.algos.replay import sample
from mjx_arm.config import TrainConfig, set_train_options, train_config
from mjx_arm.options import get_option
from mjx_arm.presets import PRESETS
from mjx_arm.training import evaluate, runner
from mjx_arm.training.loop import (
    EVALUATION,
    SELECTION,
    TRAINING,
    Trainer,
    make_body,
    make_train,
    make_trainer,
    role_key,
    run_keys,
    summarise,
)

CONFIG = train_config(
    physics="native",
    num_envs=4,
    size=(16, 16),
    replay_size=400,
    batch_size=8,
    learning_starts=40,
    chunk_steps=80,
    max_steps=15,
    widths=(4, 4, 4),
    hidden=16,
)


def bits(tree):
    return [
        np.asarray(jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x)
        for x in jax.tree.leaves(tree)
    ]


class Fixed(nn.Module):
    """Prefers action 0 whatever it sees."""

    @nn.compact
    def __call__(self, obs):
        scale = self.param("scale", nn.initializers.ones, (), jnp.float32)
        return jnp.tile(scale * jax.nn.one_hot(0, 14), (len(obs), 1))


def with_options(config: TrainConfig, **values) -> TrainConfig:
    return set_train_options(config, values)


def train(config: TrainConfig, chunks: int = 3, **parts):
    trainer = make_trainer(config, **parts)
    return trainer, *run_chunks(trainer, run_keys(config), chunks)


def run_chunks(trainer: Trainer, key: jax.Array, chunks: int):
    config, state, rows = trainer.config, trainer.init(key), []
    for chunk in range(1, chunks + 1):
        state, counts = trainer.run_chunk(state)
        step = chunk * config.chunk_length
        rows.append(summarise(config, trainer.algorithm, jax.device_get(counts), step))
    return state, rows


@pytest.fixture(scope="module")
def run():
    return train(CONFIG)


def test_a_chunk_compiles_once(run):
    trainer, _, _ = run
    assert trainer.run_chunk._cache_size() == 1


def test_every_step_is_counted(run):
    _, state, rows = run
    per_chunk = CONFIG.chunk_length * CONFIG.num_envs
    assert [row["env_steps"] for row in rows] == [per_chunk, 2 * per_chunk, 3 * per_chunk]
    assert int(state.replay.count) == 3 * CONFIG.chunk_length
    # Episodes of 15 steps, then one that resets: 20 steps of 4 environments end 4 or 8 of them.
    assert sum(row["episodes"] for row in rows) == 4 * (3 * CONFIG.chunk_length // 16)
    assert all(row["mean_length"] == 15 for row in rows if row["episodes"])
    assert rows[0]["updates"] < CONFIG.chunk_length == rows[-1]["updates"]
    assert all(row["diverged"] == 0 for row in rows)


def test_learning_changes_the_parameters(run):
    trainer, state, rows = run
    before = trainer.init(run_keys(CONFIG)).learner.params
    changes = [
        float(jnp.abs(a - b).max())
        for a, b in zip(*map(jax.tree.leaves, (before, state.learner.params)), strict=True)
    ]
    assert min(changes) > 0
    assert all(np.isfinite(row["loss"]) for row in rows)


def test_the_same_seed_gives_the_same_bits_and_another_seed_does_not(run):
    trainer, state, _ = run
    again, _ = run_chunks(trainer, run_keys(CONFIG), 3)
    for one, other in zip(bits(state), bits(again), strict=True):
        np.testing.assert_array_equal(one, other)
    different, _ = run_chunks(trainer, run_keys(dataclasses.replace(CONFIG, seed=1)), 1)
    pairs = zip(
        *map(jax.tree.leaves, (state.learner.params, different.learner.params)), strict=True
    )
    assert all((np.asarray(a) != np.asarray(b)).any() for a, b in pairs)


def test_replay_holds_each_frame_once_and_masks_only_resets(run):
    _, state, _ = run
    masked = np.asarray(state.replay.steps.masked)[: int(state.replay.count)]
    ended = np.asarray(state.replay.steps.truncated | state.replay.steps.terminated)
    np.testing.assert_array_equal(masked[1:], ended[: len(masked) - 1])
    assert masked.sum() > 0


def test_both_storages_give_the_same_batches():
    # Without an update the two runs do the same.
    config = with_options(CONFIG, learning_starts=400, n_step=3)
    batches, images = [], []
    for storage in ("states", "pixels"):
        stored = with_options(config, storage=storage)
        replay = train(stored, chunks=3)[1].replay
        batch = sample(replay, jax.random.key(0), 64, config.algo.n_step, config.algo.gamma)
        decode = jax.jit(make_body(stored).algorithm.frames.decode)
        batches.append(batch.replace(frame=None, next_frame=None))
        images.append(np.stack([decode(batch.frame), decode(batch.next_frame)]))
    for a, b in zip(*map(jax.tree.leaves, batches), strict=True):
        np.testing.assert_array_equal(a, b)
    assert 0 < batches[0].weight.sum() < 64
    # Poses by C and by our kinematics differ in the last bit, which may tip a pixel on an edge, or
    # a colour to the next of its 255 levels.
    same_geom = np.asarray(mjx_arm.segmentation(images[0]) == mjx_arm.segmentation(images[1]))
    assert np.mean(same_geom) > 1 - 2e-3
    colours = [np.asarray(mjx_arm.rgb(x), int)[same_geom] for x in images]
    assert np.abs(colours[0] - colours[1]).max() <= 1


def test_the_options_of_the_paper_train():
    small = ("physics", "num_envs", "size", "replay_size", "batch_size", "learning_starts")
    small += ("chunk_steps", "widths", "hidden")
    config = with_options(PRESETS["paper"], **{name: get_option(CONFIG, name) for name in small})
    config = with_options(config, updates_per_step=2, target_period=7, learning_rate=1e-3)
    assert (config.algo.huber, config.algo.double, config.algo.polyak) == (False, False, 0.0)
    _, state, rows = train(config, chunks=2)
    assert rows[-1]["updates"] == 2 * config.chunk_length
    assert int(state.learner.updates) % config.algo.target_period != 0
    assert np.isfinite(rows[-1]["loss"])
    # Copies are some updates old.
    pairs = map(jax.tree.leaves, (state.learner.params, state.learner.target_params))
    assert all((np.asarray(a) != np.asarray(b)).any() for a, b in zip(*pairs, strict=True))


def test_the_metric_epsilon_is_the_share_of_random_actions():
    """The network always prefers action 0, and never learns."""
    config = with_options(
        CONFIG,
        observation="state",
        num_envs=16,
        chunk_steps=16 * 400,
        replay_size=16 * 400,
        learning_starts=10**6,
        epsilon_start=0.5,
        epsilon_steps=1,
        epsilon_end=0.3,
    )
    _, state, rows = train(config, chunks=1, network=Fixed())
    random = 14 / 13 * np.mean(np.asarray(state.replay.steps.action) != 0)
    assert rows[0]["epsilon"] == pytest.approx(0.3, rel=1e-5)
    assert random == pytest.approx(rows[0]["epsilon"], abs=0.03)


def test_the_metric_epsilon_is_what_is_left_after_the_cut():
    config = with_options(CONFIG, num_envs=64, epsilon_steps=10**6)
    trainer = make_trainer(with_options(config, observation="state"))
    zeros = jax.tree.map(
        lambda x: np.zeros(x.shape),
        jax.eval_shape(lambda key: trainer.init(key).counts, run_keys(config)),
    )
    row = summarise(config, trainer.algorithm, zeros, 0)
    shares = spread_epsilon(config.exploration, jnp.float32(1.0), 64)
    assert row["epsilon"] == pytest.approx(float(shares.mean()))
    # The largest shares are cut to 1, so that the first mean is below the 1.0 of the schedule.
    assert row["epsilon"] == pytest.approx(0.681, abs=0.001)
    assert epsilon_at(config.exploration, jnp.int32(0)) == 1.0


def test_no_seed_of_a_training_meets_the_starts_that_judge_it():
    """Neither as a seed of the run nor as a key of an environment."""

    def keys_of(key: jax.Array) -> set[tuple[int, ...]]:
        split = jax.random.split(jax.random.split(key, 3)[0], 64)
        return {tuple(map(int, x)) for x in np.asarray(jax.random.key_data(split))}

    seeds = [0, 1, 7, 1_000_003, 2_000_003, 2**31 - 1]
    training = [keys_of(role_key(seed, TRAINING)) for seed in seeds]
    judging = [keys_of(role_key(s, role)) for s in seeds for role in (SELECTION, EVALUATION)]
    for index, keys in enumerate([*training, *judging]):
        for other in [*training, *judging][index + 1 :]:
            assert not keys & other


def test_a_training_never_starts_from_a_start_that_judges_it():
    options = {"env": "B", "observation": "state", "num_envs": 64, "placement": "always"}
    trainer = make_trainer(with_options(CONFIG, **options))
    start_training = jax.jit(lambda key: trainer.init(key).envs.env.physics.qpos)
    auto = mjx_arm.AutoReset(trainer.env)
    start_judging = jax.jit(lambda key: evaluate._start(auto, 64, key).envs.env.physics.qpos)

    def rows(qpos: jax.Array) -> set[tuple[float, ...]]:
        return {tuple(row) for row in np.asarray(qpos).tolist()}

    judging = set()
    for seed, role in (
        (runner._SELECTION_SEED, SELECTION),
        (runner._EVALUATION_SEED, EVALUATION),
        (7, EVALUATION),  # that of the command `eval`
    ):
        starts = rows(start_judging(role_key(seed, role)))
        assert len(starts) == 64
        assert not judging & starts
        judging |= starts
    for seed in (0, 7, 1_000_003, 2_000_003):
        assert not judging & rows(start_training(run_keys(with_options(CONFIG, seed=seed))))


def test_seeds_side_by_side_have_the_keys_of_single_runs():
    several = run_keys(with_options(CONFIG, seed=5, num_seeds=3))
    for index in range(3):
        single = run_keys(with_options(CONFIG, seed=5 + index))
        assert bits(several[index])[0].tolist() == bits(single)[0].tolist()


def test_state_features_train_too():
    _, _, rows = train(with_options(CONFIG, observation="state"), chunks=1)
    assert rows[0]["updates"] > 0


@pytest.mark.parametrize("storage", [pytest.param("states", marks=pytest.mark.slow), "pixels"])
def test_seeds_side_by_side_are_the_runs_one_by_one(storage):
    config = with_options(CONFIG, storage=storage)
    trainer = make_trainer(dataclasses.replace(config, num_seeds=2))
    both, counts = trainer.run_chunk(trainer.init(run_keys(trainer.config)))
    single = make_trainer(config)
    for seed in (0, 1):
        alone, _ = run_chunks(single, run_keys(dataclasses.replace(config, seed=seed)), 1)
        np.testing.assert_array_equal(both.replay.steps.action[seed], alone.replay.steps.action)
        for a, b in zip(
            jax.tree.leaves(both.learner.params), jax.tree.leaves(alone.learner.params), strict=True
        ):
            np.testing.assert_allclose(a[seed], b, atol=1e-4)
    assert counts["updates"].shape == (2,)


def test_a_whole_run_is_one_function(run):
    _, state, rows = run
    total = 3 * CONFIG.chunk_length * CONFIG.num_envs
    whole = make_train(with_options(CONFIG, total_steps=total))
    final, counts = jax.jit(whole)(run_keys(CONFIG))
    assert counts["updates"].tolist() == [row["updates"] for row in rows]
    for a, b in zip(bits(final.learner.params), bits(state.learner.params), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5)


def test_configuration_is_never_mutated(run):
    trainer, _, _ = run
    assert trainer.config == CONFIG
    with pytest.raises(dataclasses.FrozenInstanceError):
        trainer.config.seed = 2


def test_a_chunk_is_a_program_for_cuda_without_a_call_of_the_host(monkeypatch):
    """As far as a machine without a GPU can tell: what jax hands to the compiler."""
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    trainer = make_trainer(with_options(CONFIG, physics="auto"))
    shapes = jax.eval_shape(trainer.init, run_keys(CONFIG))
    program = trainer.run_chunk.trace(shapes).lower(lowering_platforms=("cuda",)).as_text()
    calls = set(re.findall(r"custom_call @(\w+)", program))
    assert calls == {"cusolver_potrf_ffi"}, "MJX's batched Cholesky, on the device"


@pytest.mark.slow
def test_mjx_trains_too():
    _, _, rows = train(with_options(CONFIG, physics="mjx", total_steps=160), chunks=2)
    assert rows[-1]["updates"] > 0
    assert rows[-1]["diverged"] == 0
    assert np.isfinite(rows[-1]["loss"])


def test_many_observations_get_the_values_that_few_get(run):
    trainer, state, _ = run
    params = state.learner.params
    obs = jax.random.bits(jax.random.key(0), (128, 16, 16), jnp.uint32)
    together = trainer.algorithm.apply(params, obs)
    apart = [trainer.algorithm.apply(params, part) for part in jnp.split(obs, 4)]
    np.testing.assert_allclose(together, jnp.concatenate(apart), rtol=1e-5, atol=1e-5)
