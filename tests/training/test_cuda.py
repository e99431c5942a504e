"""Programs for CUDA, as far as a machine without a GPU can tell: what jax hands to the compiler."""

from __future__ import annotations

import re

import jax
import pytest

from mjx_arm.config import set_train_options, train_config
from mjx_arm.training.evaluate import make_programs
from mjx_arm.training.loop import make_trainer, run_keys

CONFIG = train_config(
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
DISTILL = {
    "algorithm": "distill",
    "teacher_batch_size": 16,
    "teacher_hidden": 16,
    "student_batch_size": 8,
    "student_starts": 80,
}
# MJX's batched Cholesky, on the device.
CHOLESKY = {"cusolver_potrf_ffi"}


@pytest.fixture(autouse=True)
def on_a_gpu(monkeypatch):
    """Everything is chosen as on a GPU: the physics, the convolutions, the sizes of batches."""
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")


def calls(function: jax.stages.Wrapped, *shapes) -> set[str]:
    """Names of what a program for CUDA calls outside of itself."""
    program = function.trace(*shapes).lower(lowering_platforms=("cuda",)).as_text()
    return set(re.findall(r"custom_call @(\w+)", program)) - {"Sharding", "SPMDFullToShardShape"}


@pytest.mark.slow
@pytest.mark.parametrize("options", [{"updates_per_step": 2}, DISTILL])
def test_a_chunk_of_both_algorithms(options):
    trainer = make_trainer(set_train_options(CONFIG, options))
    shapes = jax.eval_shape(trainer.init, run_keys(trainer.config))
    assert calls(trainer.run_chunk, shapes) == CHOLESKY


@pytest.mark.slow
def test_the_evaluator():
    trainer = make_trainer(CONFIG)
    key = jax.random.key(0)
    shapes = jax.eval_shape(trainer.init, key)
    policy = jax.eval_shape(trainer.algorithm.policy, shapes.learner)
    start, advance = make_programs(
        trainer.env, trainer.algorithm.apply, episodes=8, epsilon=0.1, mesh=None
    )
    assert calls(advance, policy, jax.eval_shape(start, key)) == CHOLESKY
    assert calls(start, key) <= CHOLESKY


@pytest.mark.slow
def test_the_renderer():
    env = make_trainer(CONFIG).env
    state = jax.eval_shape(jax.vmap(env.reset), jax.random.split(jax.random.key(0), 4))[1]
    assert calls(jax.jit(jax.vmap(env.observe)), state) == set()
