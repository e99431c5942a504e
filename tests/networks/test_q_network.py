from __future__ import annotations

import dataclasses

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_arm.config import train_config
from mjx_arm.networks.convolution import max_pool
from mjx_arm.networks.q_network import FeatureQNetwork, PatchConv, PixelQNetwork, make_network


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


def test_both_convolutions_give_the_same_network():
    config = train_config(widths=(4, 4, 4), hidden=16).network
    packed = jax.random.bits(jax.random.key(0), (2, 32, 32), jnp.uint32)
    values, params = [], None
    for convolution in ("patches", "nn.Conv"):
        chosen = dataclasses.replace(config, convolution=convolution)
        network = make_network(chosen, num_actions=14, feature_scales=None)
        params = network.init(jax.random.key(1), packed) if params is None else params
        values.append(network.apply(params, packed))
    np.testing.assert_allclose(values[0], values[1], rtol=1e-4, atol=1e-5)


def test_several_cameras_are_channels():
    network = PixelQNetwork(14, (4, 4, 4), (5, 3, 3), (2, 1, 1), 2, 16, False)
    packed = jax.random.bits(jax.random.key(0), (2, 3, 32, 32), jnp.uint32)
    params = network.init(jax.random.key(1), packed)
    assert params["params"]["PatchConv_0"]["kernel"].shape == (5, 5, 9, 4)
    # At first all Q-values are 0.
    assert not np.asarray(network.apply(params, packed)).any()
    params = jax.tree.map(lambda x: x + 0.1, params)
    q = network.apply(params, packed)
    assert q.shape == (2, 14)
    # Which camera shows an image matters.
    assert (np.asarray(network.apply(params, packed[:, ::-1])) != np.asarray(q)).any()


def test_features_are_scaled_before_they_are_used():
    plain, scaled = FeatureQNetwork(14, 16, True), FeatureQNetwork(14, 16, True, (2.0, 0.5, 1.0))
    x = jnp.asarray([[1.0, 2.0, 3.0]])
    params = plain.init(jax.random.key(0), x)
    expected = plain.apply(params, jnp.asarray([[2.0, 1.0, 3.0]]))
    np.testing.assert_array_equal(scaled.apply(params, x), expected)


@pytest.mark.parametrize(
    ("network", "message"),
    [
        ("nowhere:Net", "network: module 'nowhere' cannot be imported"),
        ("mjx_arm.networks:Nothing", "has no 'Nothing'"),
        ("mjx_arm.networks:PixelQNetwork", "with the one attribute num_actions"),
    ],
)
def test_a_network_that_cannot_be_made_is_rejected(network, message):
    config = train_config(network=network).network
    with pytest.raises(ValueError, match=message) as raised:
        make_network(config, num_actions=14, feature_scales=None)
    assert "\n" not in str(raised.value)
