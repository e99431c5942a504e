"""The Q-network of the paper: three convolutions, max-pooling between them, two dense layers.

The paper names no sizes; widths, kernels and strides are our choice, made on two CPU cores.
"""

from __future__ import annotations

from collections.abc import Sequence

import flax.linen as nn
import jax
import jax.numpy as jnp

from mjx_arm.convolution import convolve, max_pool
from mjx_arm.render import rgb


class PatchConv(nn.Module):
    """A convolution with max-pooling after it, equal to `nn.Conv` and `nn.max_pool`.

    Attributes:
      features: output channels.
      kernel: edge of the square kernel.
      stride: step of the kernel in both directions.
      pool: edge of the max-pooling, 1 for none.
    """

    features: int
    kernel: int
    stride: int = 1
    pool: int = 1

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Convolves `[B, H, W, C] float32`, padding "SAME", and pools: `[B, H', W', features]`."""
        shape = (self.kernel, self.kernel, x.shape[-1], self.features)
        kernel = self.param("kernel", nn.initializers.he_normal(), shape, jnp.float32)
        bias = self.param("bias", nn.initializers.zeros, (self.features,), jnp.float32)
        # The bias after the pooling: the same values with less to add.
        return max_pool(convolve(x, kernel, self.stride), self.pool) + bias


class Head(nn.Module):
    """The dense layers: one hidden, one output; with `dueling` a value and an advantage stream."""

    hidden: int
    num_actions: int
    dueling: bool

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Q-values of features `[B, F] float32`: `[B, num_actions] float32`."""
        x = nn.relu(nn.Dense(self.hidden, kernel_init=nn.initializers.he_normal())(x))
        advantage = nn.Dense(self.num_actions)(x)
        if not self.dueling:
            return advantage
        value = nn.Dense(1)(x)
        return value + advantage - jnp.mean(advantage, axis=-1, keepdims=True)


class PixelQNetwork(nn.Module):
    """Q-values from packed pixels.

    Attributes:
      num_actions: outputs.
      widths: channels of the three convolutions.
      kernels: their kernels' edges.
      strides: their strides.
      pool: edge of the max-pooling between them, 1 for none.
      hidden: units of the first dense layer.
      dueling: split the last layer into value and advantage (Wang et al. 2016).
    """

    num_actions: int
    widths: Sequence[int]
    kernels: Sequence[int]
    strides: Sequence[int]
    pool: int
    hidden: int
    dueling: bool

    @nn.compact
    def __call__(self, packed: jax.Array) -> jax.Array:
        """Q-values of packed images `[B, H, W] uint32`: `[B, num_actions] float32`."""
        x = rgb(packed).astype(jnp.float32) / 255.0 - 0.5
        for layer, (width, kernel, stride) in enumerate(
            zip(self.widths, self.kernels, self.strides, strict=True)
        ):
            pool = self.pool if layer < len(self.widths) - 1 else 1
            x = nn.relu(PatchConv(width, kernel, stride, pool)(x))
        x = x.reshape(x.shape[0], -1)
        return Head(self.hidden, self.num_actions, self.dueling)(x)


class FeatureQNetwork(nn.Module):
    """Q-values from the state features, two hidden layers; a rung below pixels."""

    num_actions: int
    hidden: int
    dueling: bool

    @nn.compact
    def __call__(self, features: jax.Array) -> jax.Array:
        """Q-values of features `[B, F] float32`: `[B, num_actions] float32`."""
        x = nn.relu(nn.Dense(self.hidden, kernel_init=nn.initializers.he_normal())(features))
        return Head(self.hidden, self.num_actions, self.dueling)(x)
