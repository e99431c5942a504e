"""The layers of the Q-network: shapes, parameters, multiply-adds."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import numpy as np

from mjx_arm.networks.q_network import PixelQNetwork
from mjx_arm.training.agent import flatten_params


@dataclasses.dataclass(frozen=True)
class Layer:
    """One layer.

    Attributes:
      name: what it is.
      output: shape of its output without the batch.
      params: number of its parameters.
      operations: multiply-adds for one image.
    """

    name: str
    output: tuple[int, ...]
    params: int
    operations: int


def layers_of(network: PixelQNetwork, *, size: tuple[int, int], cameras: int = 1) -> list[Layer]:
    """The layers of the shipped network, in order.

    Args:
      network: the module.
      size: height and width of an image, pixels.
      cameras: whose images are stacked.
    """
    height, width = size
    channels = 3 * cameras
    layers = [Layer(f"image of {height}×{width} pixels, RGB", (height, width, channels), 0, 0)]
    for i, (features, kernel, stride) in enumerate(
        zip(network.widths, network.kernels, network.strides, strict=True)
    ):
        height, width = -(-height // stride), -(-width // stride)
        weights = kernel * kernel * channels * features
        name = f"convolution {kernel}×{kernel}, stride {stride}, ReLU"
        shape = (height, width, features)
        layers.append(Layer(name, shape, weights + features, weights * height * width))
        channels = features
        if i < len(network.widths) - 1 and network.pool > 1:
            height, width = height // network.pool, width // network.pool
            name = f"max-pooling {network.pool}×{network.pool}"
            layers.append(Layer(name, (height, width, channels), 0, 0))
    return layers + _dense_layers(network, height * width * channels)


def _dense_layers(network: PixelQNetwork, inputs: int) -> list[Layer]:
    layers, hidden, actions = [], network.hidden, network.num_actions
    for _ in range(network.layers):
        norm = 2 * hidden if network.layer_norm else 0
        name = "fully connected, LayerNorm, ReLU" if network.layer_norm else "fully connected, ReLU"
        params = inputs * hidden + hidden + norm
        layers.append(Layer(name, (hidden,), params, inputs * hidden))
        inputs = hidden
    outputs = actions + 1 if network.dueling else actions
    name = "Q-values, of a value and advantages" if network.dueling else "Q-values"
    layers.append(Layer(name, (actions,), inputs * outputs + outputs, inputs * outputs))
    return layers


def count_params(params: Any) -> int:
    """Number of parameters in a tree of arrays."""
    return sum(int(np.size(x)) for x in flatten_params(jax.device_get(params)).values())
