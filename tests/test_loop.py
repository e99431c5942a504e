from __future__ import annotations

import dataclasses
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjx_arm
from mjx_arm.config import PRESETS, TrainConfig
from mjx_arm.loop import (
    Trainer,
    epsilon_at,
    make_body,
    make_train,
    make_trainer,
    run_keys,
    spread_epsilon,
    summarise,
)
from mjx_arm.replay import sample

CONFIG = TrainConfig(
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


def train(config: TrainConfig, chunks: int = 3):
    trainer = make_trainer(config)
    return trainer, *run_chunks(trainer, run_keys(config), chunks)


def run_chunks(trainer: Trainer, key: jax.Array, chunks: int):
    config, state, rows = trainer.config, trainer.init(key), []
    for chunk in range(1, chunks + 1):
        state, counts = trainer.run_chunk(state)
        rows.append(summarise(config, jax.device_get(counts), chunk * config.chunk_length))
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
    before = trainer.init(jax.random.key(CONFIG.seed)).learner.params
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


def test_replay_holds_each_frame_once_and_voids_only_resets(run):
    _, state, _ = run
    void = np.asarray(state.replay.steps.void)[: int(state.replay.count)]
    ended = np.asarray(state.replay.steps.truncated | state.replay.steps.terminated)
    np.testing.assert_array_equal(void[1:], ended[: len(void) - 1])
    assert void.sum() > 0


def test_both_storages_give_the_same_batches():
    # Without an update the two runs do the same.
    config = dataclasses.replace(CONFIG, learning_starts=400, n_step=3)
    batches, images = [], []
    for storage in ("states", "pixels"):
        stored = dataclasses.replace(config, storage=storage)
        replay = train(stored, chunks=3)[1].replay
        batch = sample(replay, jax.random.key(0), 64, config.n_step, config.gamma)
        restore = jax.jit(make_body(stored).storage.restore)
        batches.append(batch.replace(frame=None, next_frame=None))
        images.append(np.stack([restore(batch.frame), restore(batch.next_frame)]))
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
    paper = dataclasses.asdict(PRESETS["paper"])
    sizes = {field.name: getattr(CONFIG, field.name) for field in dataclasses.fields(CONFIG)}
    small = ("physics", "num_envs", "size", "replay_size", "batch_size", "learning_starts")
    small += ("chunk_steps", "widths", "hidden")
    config = TrainConfig(**paper | {name: sizes[name] for name in small})
    config = dataclasses.replace(config, updates_per_step=2, target_period=7, learning_rate=1e-3)
    assert (config.huber, config.double, config.polyak) == (False, False, 0.0)
    _, state, rows = train(config, chunks=2)
    assert rows[-1]["updates"] == 2 * config.chunk_length
    assert int(state.learner.updates) % config.target_period != 0
    assert np.isfinite(rows[-1]["loss"])
    # Copies are some updates old.
    pairs = map(jax.tree.leaves, (state.learner.params, state.learner.target_params))
    assert all((np.asarray(a) != np.asarray(b)).any() for a, b in zip(*pairs, strict=True))


@pytest.mark.parametrize(("steps", "expected"), [(0, 1.0), (50_000, 0.55), (100_000, 0.1)])
def test_epsilon_falls_linearly(steps, expected):
    assert epsilon_at(TrainConfig(), jnp.int32(steps)) == pytest.approx(expected)
    assert epsilon_at(TrainConfig(), jnp.int32(10 * 100_000)) == pytest.approx(0.1)


def test_environments_explore_in_equal_ratios_around_epsilon():
    config = TrainConfig(num_envs=5, epsilon_spread=4.0)
    shares = spread_epsilon(config, jnp.float32(0.1))
    np.testing.assert_allclose(shares, [0.025, 0.05, 0.1, 0.2, 0.4], rtol=1e-5)
    assert spread_epsilon(config, jnp.float32(0.6)).max() == 1.0
    alike = dataclasses.replace(config, epsilon_spread=1.0)
    np.testing.assert_allclose(spread_epsilon(alike, jnp.float32(0.1)), 0.1, rtol=1e-6)
    alone = dataclasses.replace(config, num_envs=1)
    np.testing.assert_allclose(spread_epsilon(alone, jnp.float32(0.1)), [0.1], rtol=1e-6)


def test_state_features_train_too():
    _, _, rows = train(dataclasses.replace(CONFIG, observation="state"), chunks=1)
    assert rows[0]["updates"] > 0


@pytest.mark.parametrize("storage", [pytest.param("states", marks=pytest.mark.slow), "pixels"])
def test_seeds_side_by_side_are_the_runs_one_by_one(storage):
    config = dataclasses.replace(CONFIG, storage=storage)
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
    final, counts = jax.jit(make_train(dataclasses.replace(CONFIG, total_steps=total)))(
        jax.random.key(CONFIG.seed)
    )
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
    trainer = make_trainer(dataclasses.replace(CONFIG, physics="auto"))
    shapes = jax.eval_shape(trainer.init, run_keys(CONFIG))
    program = trainer.run_chunk.trace(shapes).lower(lowering_platforms=("cuda",)).as_text()
    calls = set(re.findall(r"custom_call @(\w+)", program))
    assert calls == {"cusolver_potrf_ffi"}, "MJX's batched Cholesky, on the device"


@pytest.mark.slow
def test_mjx_trains_too():
    _, _, rows = train(dataclasses.replace(CONFIG, physics="mjx", total_steps=160), chunks=2)
    assert rows[-1]["updates"] > 0
    assert rows[-1]["diverged"] == 0
    assert np.isfinite(rows[-1]["loss"])


def test_many_observations_get_the_values_that_few_get(run):
    trainer, state, _ = run
    params = state.learner.params
    obs = jax.random.bits(jax.random.key(0), (128, 16, 16), jnp.uint32)
    together = trainer.dqn.apply(params, obs)
    apart = [trainer.dqn.apply(params, part) for part in jnp.split(obs, 4)]
    np.testing.assert_allclose(together, jnp.concatenate(apart), rtol=1e-5, atol=1e-5)
