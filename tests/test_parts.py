from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_arm.parts import in_parts, overwrite_in_parts


def sums(batch: dict) -> dict:
    return {"sum": batch["x"] + batch["y"][:, None], "y": batch["y"] + 1}


def batch_of(rows: int) -> dict:
    key = jax.random.key(rows)
    return {"x": jax.random.normal(key, (rows, 3)), "y": jnp.arange(rows, dtype=jnp.float32)}


# One row, just one part, a part and a bit, whole parts.
@pytest.mark.parametrize("rows", [1, 64, 65, 128, 256])
def test_parts_are_the_whole(rows):
    batch = batch_of(rows)
    whole = sums(batch)
    junk = jax.tree.map(lambda x: jnp.full_like(x, jnp.nan), whole)
    for result in (in_parts(sums)(batch), overwrite_in_parts(sums, batch, junk)):
        jax.tree.map(np.testing.assert_array_equal, result, whole)


def test_a_carry_is_written_over_in_place():
    """A scan over 4,096 pictures needs less to work in than one more set of them."""
    if jax.default_backend() != "cpu":
        pytest.skip("whole batches are worked on at once there")
    envs, picture = jnp.zeros((4096, 2)), (32, 32)
    old = jnp.zeros((4096, *picture))

    def run(envs: jax.Array, old: jax.Array) -> jax.Array:
        def draw(envs: jax.Array) -> jax.Array:
            return jnp.sin(envs[:, :1, None] * jnp.ones(picture)) + envs[:, 1:, None]

        def step(carry: tuple, _: None) -> tuple:
            envs, old = carry
            envs = envs + 1e-9 * jnp.sum(old, axis=(1, 2))[:, None]
            return (envs, overwrite_in_parts(draw, envs, old)), None

        return jax.lax.scan(step, (envs, old), None, length=3)[0][1]

    compiled = jax.jit(run, donate_argnums=1).lower(envs, old).compile()
    assert compiled.memory_analysis().temp_size_in_bytes < old.nbytes / 2
