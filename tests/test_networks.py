from __future__ import annotations

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_arm.convolution import max_pool
from mjx_arm.networks import FeatureQNetwork, PatchConv, PixelQNetwork


@pytest.mark.parametrize(("kernel", "stride"), [(5, 2), (3, 1), (4, 2), (4, 3), (1, 1)])
@pytest.mark.parametrize("size", [(16, 16), (13, 10)])
def test_patch_convolution_equals_flax(kernel, stride, size):
    x = jax.random.normal(jax.random.key(0), (2, *size, 3))
    ours = PatchConv(features=8, kernel=kernel, stride=stride)
    params = ours.init(jax.random.key(1), x)
    theirs = nn.Conv(8, (kernel, kernel), strides=stride, padding="SAME")

    def loss(apply, params):
        return jnp.sum(jnp.sin(apply(params, x)))

    np.testing.assert_allclose(ours.apply(params, x), theirs.apply(params, x), atol=1e-5)
    grads = [jax.grad(lambda p, m=m: loss(m.apply, p))(params) for m in (ours, theirs)]
    for one, other in zip(*map(jax.tree.leaves, grads), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("size", [1, 2, 3])
def test_max_pool_equals_flax(size):
    # Few values, so that many windows have several maxima: the first gets the gradient.
    x = jax.random.randint(jax.random.key(0), (2, 9, 8, 3), 0, 4).astype(jnp.float32)

    def theirs(x):
        return nn.max_pool(x, (size, size), (size, size))

    np.testing.assert_array_equal(max_pool(x, size), theirs(x))
    grad = jax.random.normal(jax.random.key(1), theirs(x).shape)
    ours = jax.vjp(lambda x: max_pool(x, size), x)[1](grad)[0]
    np.testing.assert_array_equal(ours, jax.vjp(theirs, x)[1](grad)[0])


def test_pooling_before_the_bias_changes_no_value():
    x = jax.random.normal(jax.random.key(0), (2, 16, 16, 3))
    params = PatchConv(8, 3).init(jax.random.key(1), x)
    params["params"]["bias"] = jax.random.normal(jax.random.key(2), (8,))
    pooled = PatchConv(8, 3, pool=2).apply(params, x)
    np.testing.assert_array_equal(pooled, max_pool(PatchConv(8, 3).apply(params, x), 2))


@pytest.mark.parametrize("dueling", [False, True])
def test_networks_give_a_value_an_action(dueling):
    pixel = PixelQNetwork(14, (4, 4, 4), (5, 3, 3), (2, 1, 1), 2, 16, dueling)
    packed = jnp.arange(2 * 64 * 64, dtype=jnp.uint32).reshape(2, 64, 64)
    feature = FeatureQNetwork(14, 16, dueling)
    for network, obs in ((pixel, packed), (feature, jnp.ones((2, 21)))):
        params = network.init(jax.random.key(0), obs)
        q = network.apply(params, obs)
        assert (q.shape, q.dtype) == ((2, 14), jnp.float32)
        assert np.isfinite(q).all()


def test_geom_ids_are_not_shown_to_the_network():
    network = PixelQNetwork(14, (4, 4, 4), (5, 3, 3), (2, 1, 1), 2, 16, False)
    packed = jnp.full((1, 64, 64), 0x00336699, jnp.uint32)
    params = network.init(jax.random.key(0), packed)
    marked = packed | jnp.uint32(7 << 24)
    np.testing.assert_array_equal(network.apply(params, packed), network.apply(params, marked))
