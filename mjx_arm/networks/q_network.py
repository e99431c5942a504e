"""The Q-network of the paper: three convolutions, max-pooling between them, two dense layers.

The paper names no sizes; widths, kernels and strides are our choice, made on two CPU cores.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

from mjx_arm.config import NetworkConfig
from mjx_arm.networks.convolution import convolve, max_pool
from mjx_arm.references import load_reference
from mjx_arm.render import rgb


class PatchConv(nn.Module):
    """A convolution with max-pooling after it, equal to `nn.Conv` and `nn.max_pool`.

    Attributes:
      features: output channels.
      kernel: edge of the square kernel.
      stride: step of the kernel in both directions.
      pool: edge of the max-pooling, 1 for none.
      patches: one matrix product over patches, which is faster on a CPU; else XLA's convolution.
    """

    features: int
    kernel: int
    stride: int = 1
    pool: int = 1
    patches: bool = True

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Convolves `[B, H, W, C] float32`, padding "SAME", and pools: `[B, H', W', features]`."""
        shape = (self.kernel, self.kernel, x.shape[-1], self.features)
        kernel = self.param("kernel", nn.initializers.he_normal(), shape, jnp.float32)
        bias = self.param("bias", nn.initializers.zeros, (self.features,), jnp.float32)
        if not self.patches:
            strides = (self.stride, self.stride)
            dimensions = ("NHWC", "HWIO", "NHWC")
            x = jax.lax.conv_general_dilated(
                x, kernel, strides, "SAME", dimension_numbers=dimensions
            )
            window = (self.pool, self.pool)
            # By keywords: jax2onnx knows no other call.
            pooled = nn.max_pool(x, window_shape=window, strides=window) if self.pool > 1 else x
            return pooled + bias
        # The bias after the pooling: the same values with less to add.
        return max_pool(convolve(x, kernel, self.stride), self.pool) + bias


class Head(nn.Module):
    """Hidden dense layers and an output; with `dueling` a value and an advantage stream.

    At first all Q-values are 0. Random ones would differ between actions by far more than the true
    ones do, and would have to be unlearnt.
    """

    hidden: int
    num_actions: int
    dueling: bool
    layer_norm: bool = False
    layers: int = 1

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Q-values of features `[B, F] float32`: `[B, num_actions] float32`."""
        for _ in range(self.layers):
            x = nn.Dense(self.hidden, kernel_init=nn.initializers.he_normal())(x)
            x = nn.relu(nn.LayerNorm()(x) if self.layer_norm else x)
        zeros = nn.initializers.zeros_init()
        advantage = nn.Dense(self.num_actions, kernel_init=zeros)(x)
        if not self.dueling:
            return advantage
        value = nn.Dense(1, kernel_init=zeros)(x)
        return value + advantage - jnp.mean(advantage, axis=-1, keepdims=True)


class PixelQNetwork(nn.Module):
    """Q-values from packed pixels, of one camera or of several stacked ones.

    Attributes:
      num_actions: outputs.
      widths: channels of the three convolutions.
      kernels: their kernels' edges.
      strides: their strides.
      pool: edge of the max-pooling between them, 1 for none.
      hidden: units of the first dense layer.
      dueling: split the last layer into value and advantage (Wang et al. 2016).
      layer_norm: LayerNorm after each hidden dense layer.
      layers: number of hidden dense layers.
      patches: how to convolve; see `PatchConv`.
    """

    num_actions: int
    widths: Sequence[int]
    kernels: Sequence[int]
    strides: Sequence[int]
    pool: int
    hidden: int
    dueling: bool
    layer_norm: bool = False
    layers: int = 1
    patches: bool = True

    @nn.compact
    def __call__(self, packed: jax.Array) -> jax.Array:
        """Q-values of packed images: `[B, num_actions] float32`.

        Args:
          packed: `[B, H, W] uint32`, or `[B, C, H, W]` of several cameras.
        """
        x = rgb(packed).astype(jnp.float32) / 255.0 - 0.5
        if x.ndim == 5:  # the cameras' colours as channels
            x = jnp.moveaxis(x, 1, 3).reshape(x.shape[0], *x.shape[2:4], -1)
        for layer, (width, kernel, stride) in enumerate(
            zip(self.widths, self.kernels, self.strides, strict=True)
        ):
            pool = self.pool if layer < len(self.widths) - 1 else 1
            x = nn.relu(PatchConv(width, kernel, stride, pool, self.patches)(x))
        x = x.reshape(x.shape[0], -1)
        head = Head(self.hidden, self.num_actions, self.dueling, self.layer_norm, self.layers)
        q: jax.Array = head(x)
        return q


class FeatureQNetwork(nn.Module):
    """Q-values from state features, two hidden layers; a rung below pixels.

    Attributes:
      num_actions: outputs.
      hidden: units of each hidden layer.
      dueling: split the last layer into value and advantage.
      scales: factors that bring the features to a size of about 1; empty for none.
      layer_norm: LayerNorm after each hidden layer.
    """

    num_actions: int
    hidden: int
    dueling: bool
    scales: tuple[float, ...] = ()
    layer_norm: bool = False

    @nn.compact
    def __call__(self, features: jax.Array) -> jax.Array:
        """Q-values of features `[B, F] float32`: `[B, num_actions] float32`."""
        x = features * jnp.asarray(self.scales, jnp.float32) if self.scales else features
        x = nn.Dense(self.hidden, kernel_init=nn.initializers.he_normal())(x)
        x = nn.relu(nn.LayerNorm()(x) if self.layer_norm else x)
        return Head(self.hidden, self.num_actions, self.dueling, self.layer_norm)(x)


def make_network(
    config: NetworkConfig, *, num_actions: int, feature_scales: tuple[float, ...] | None
) -> Any:
    """Makes the network of a configuration.

    Args:
      config: the options.
      num_actions: outputs.
      feature_scales: for state features, the factors that bring them to a size of about 1; None
        for pixels.

    Returns:
      A Flax module `observations [B, ...] -> Q-values [B, num_actions] float32`.

    Raises:
      ValueError: the network that the configuration names cannot be imported or made.
    """
    if config.network:
        module = load_reference(config.network, "network")
        try:
            return module(num_actions=num_actions)
        except TypeError as error:
            raise ValueError(
                f"network {config.network!r} must be a Flax module with the one attribute "
                f"num_actions ({error})"
            ) from error
    if feature_scales is not None:
        return FeatureQNetwork(
            num_actions, config.hidden, config.dueling, feature_scales, config.layer_norm
        )
    on_cpu = jax.default_backend() == "cpu"
    patches = on_cpu if config.convolution == "auto" else config.convolution == "patches"
    return PixelQNetwork(
        num_actions=num_actions,
        widths=config.widths,
        kernels=config.kernels,
        strides=config.strides,
        pool=config.pool,
        hidden=config.hidden,
        dueling=config.dueling,
        layer_norm=config.layer_norm,
        layers=config.dense_layers,
        patches=patches,
    )
