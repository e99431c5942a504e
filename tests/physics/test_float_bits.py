from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_arm.physics.float_bits import float32_to_bits, float64_to_words


def widened(values: np.ndarray) -> np.ndarray:
    words = np.asarray(jax.jit(float32_to_bits)(jnp.asarray(values)))
    return words.reshape(*words.shape[:-2], -1).view(np.float64)


def test_random_numbers_are_widened_exactly():
    random = np.random.default_rng(0)
    bits = random.integers(0, 2**32, 100_000, dtype=np.uint32)
    values = bits.view(np.float32)
    values = values[np.isfinite(values) & (np.abs(values) >= np.finfo(np.float32).tiny)]
    assert len(values) > 90_000
    assert (values < 0).any()
    np.testing.assert_array_equal(
        widened(values).view(np.uint64), values.astype(np.float64).view(np.uint64)
    )


@pytest.mark.parametrize(
    "value",
    [0.0, -0.0, 1.0, -1.0, np.inf, -np.inf, np.finfo(np.float32).max, np.finfo(np.float32).tiny],
)
def test_special_numbers_are_widened_exactly(value):
    values = np.asarray([value], np.float32)
    np.testing.assert_array_equal(
        widened(values).view(np.uint64), values.astype(np.float64).view(np.uint64)
    )


def test_nan_stays_nan():
    assert np.isnan(widened(np.asarray([np.nan], np.float32))).all()


def test_subnormals_become_zero():
    smallest = np.asarray([1e-45, -1e-45], np.float32)
    np.testing.assert_array_equal(widened(smallest), [0.0, 0.0])


def test_words_are_the_bits_of_the_number():
    values = np.random.default_rng(1).normal(size=(3, 5))
    words = float64_to_words(values)
    assert words.shape == (3, 10)
    assert words.dtype == np.uint32
    np.testing.assert_array_equal(words.view(np.float64), values)
