from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_arm.microbatch import microbatched, overwrite_microbatched


def sums(batch: dict) -> dict:
    return {"sum": batch["x"] + batch["y"][:, None], "y": batch["y"] + 1}


def batch_of(rows: int) -> dict:
    key = jax.random.key(rows)
    return {"x": jax.random.normal(key, (rows, 3)), "y": jnp.arange(rows, dtype=jnp.float32)}


# One row, one microbatch, one and a bit, whole ones.
@pytest.mark.parametrize("rows", [1, 64, 65, 128, 256])
def test_microbatches_give_what_the_whole_batch_gives(rows):
    batch = batch_of(rows)
    whole = sums(batch)
    junk = jax.tree.map(lambda x: jnp.full_like(x, jnp.nan), whole)
    for result in (microbatched(sums)(batch), overwrite_microbatched(sums, batch, junk)):
        jax.tree.map(np.testing.assert_array_equal, result, whole)


def test_a_carry_is_written_over_in_place():
    """A scan over 4,096 pictures needs less working memory than one more set of them."""
    if jax.default_backend() != "cpu":
        pytest.skip("whole batches are computed at once there")
    envs, picture = jnp.zeros((4096, 2)), (32, 32)
    old = jnp.zeros((4096, *picture))

    def run(envs: jax.Array, old: jax.Array) -> jax.Array:
        def render(envs: jax.Array) -> jax.Array:
            return jnp.sin(envs[:, :1, None] * jnp.ones(picture)) + envs[:, 1:, None]

        def step(carry: tuple, _: None) -> tuple:
            envs, old = carry
            envs = envs + 1e-9 * jnp.sum(old, axis=(1, 2))[:, None]
            return (envs, overwrite_microbatched(render, envs, old)), None

        return jax.lax.scan(step, (envs, old), None, length=3)[0][1]

    compiled = jax.jit(run, donate_argnums=1).lower(envs, old).compile()
    assert compiled.memory_analysis().temp_size_in_bytes < old.nbytes / 2
