"""The layer table against the parameters that the network really has."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_arm.config import NetworkConfig
from mjx_arm.networks.q_network import make_network
from mjx_arm.reproduce.layers import layers_of

OPTIONS = [
    {},
    {"dueling": False},
    {"layer_norm": True, "dense_layers": 2},
    {"pool": 1, "kernels": (5, 4, 3), "strides": (3, 2, 1)},
]


@pytest.mark.parametrize("options", OPTIONS)
@pytest.mark.parametrize(("size", "cameras"), [((64, 64), 1), ((50, 36), 2)])
def test_its_parameters_are_the_networks(options, size, cameras):
    network = make_network(NetworkConfig(**options), num_actions=14, feature_scales=None)
    shape = (1, *size) if cameras == 1 else (1, cameras, *size)
    made = jax.eval_shape(network.init, jax.random.key(0), jnp.zeros(shape, jnp.uint32))
    expected = sum(np.prod(x.shape) for x in jax.tree.leaves(made))
    layers = layers_of(network, size=size, cameras=cameras)
    assert sum(layer.params for layer in layers) == expected
    assert layers[-1].output == (14,)


def test_operations_worked_out_by_hand():
    network = make_network(
        NetworkConfig(widths=(2, 3, 4), kernels=(2, 1, 1), strides=(2, 1, 1), hidden=5),
        num_actions=14,
        feature_scales=None,
    )
    layers = {layer.name: layer for layer in layers_of(network, size=(8, 8))}
    # 4×4 places, 2×2×3 weights, 2 channels.
    assert layers["convolution 2×2, stride 2, ReLU"].operations == 4 * 4 * 12 * 2
    assert layers["fully connected, ReLU"].operations == 4 * 5
    assert layers["Q-values, of a value and advantages"].operations == 5 * 15
