from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_arm import rgb, segmentation

WORDS = np.asarray([0x00030201, 0xFE0000FF, 0xFF000000], np.uint32)


@pytest.mark.parametrize("shape", [(3,), (1, 3), (3, 1, 1)])
def test_unpacks_any_leading_shape(shape: tuple[int, ...]) -> None:
    packed = jnp.asarray(WORDS.reshape(shape))
    colours, geoms = jax.jit(rgb)(packed), jax.jit(segmentation)(packed)
    assert (colours.dtype, geoms.dtype) == (jnp.uint8, jnp.int32)
    assert (colours.shape, geoms.shape) == ((*shape, 3), shape)
    assert np.asarray(colours).reshape(-1, 3).tolist() == [[1, 2, 3], [255, 0, 0], [0, 0, 0]]
    assert np.asarray(geoms).reshape(-1).tolist() == [0, 254, -1]
