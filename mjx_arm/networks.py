"""The Q-network of the paper: three convolutions, max-pooling between them, two dense layers.

The paper names no sizes; widths, kernels and strides are our choice, made on two CPU cores.
"""

from __future__ import annotations

from collections.abc import Sequence

import flax.linen as nn
import jax
import jax.numpy as jnp

from mjx_arm.render import rgb


def max_pool(x: jax.Array, size: int) -> jax.Array:
    """Max-pooling without overlap: `[..., H, W, C]` to `[..., H // size, W // size, C]`.

    A reshape and a maximum: on CPU the gradient of a windowed reduction is many times slower.
    """
    *lead, height, width, channels = x.shape
    height, width = height // size, width // size
    x = x[..., : height * size, : width * size, :]
    return x.reshape(*lead, height, size, width, size, channels).max(axis=(-4, -2))


class PatchConv(nn.Module):
    """A convolution as one matrix product over patches, equal to `nn.Conv` with the same weights.

    On CPU the gradient of a convolution inside `lax.scan` takes 25 times as long as outside, that
    of this formulation does not.

    Attributes:
      features: output channels.
      kernel: edge of the square kernel.
      stride: step of the kernel in both directions.
    """

    features: int
    kernel: int
    stride: int = 1

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Convolves `[B, H, W, C] float32` with padding "SAME": `[B, H', W', features]`."""
        weights = self.param(
            "kernel",
            nn.initializers.he_normal(),
            (self.kernel, self.kernel, x.shape[-1], self.features),
            jnp.float32,
        )
        bias = self.param("bias", nn.initializers.zeros, (self.features,), jnp.float32)
        blocks = -(-self.kernel // self.stride)
        rows = patches(x, self.kernel, self.stride)
        # The kernel, padded to whole blocks, in the order of the patches: block, then pixel in it.
        spare = blocks * self.stride - self.kernel
        weights = jnp.pad(weights, ((0, spare), (0, spare), (0, 0), (0, 0)))
        weights = weights.reshape(blocks, self.stride, blocks, self.stride, -1, self.features)
        weights = weights.transpose(0, 2, 1, 3, 4, 5).reshape(-1, self.features)
        return rows @ weights + bias


def patches(x: jax.Array, kernel: int, stride: int) -> jax.Array:
    """Patches of an image padded as by "SAME": `[B, H, W, C]` to `[B, H', W', P]`.

    The image is cut into blocks of `stride` pixels first, so that a patch is a few long runs of
    memory instead of many short ones; `P` is `C` times the pixels of the blocks that hold a kernel.
    """
    batch, _, _, channels = x.shape
    blocks = -(-kernel // stride)
    pads, counts = [], []
    for size in x.shape[1:3]:
        count = -(-size // stride)
        before = max((count - 1) * stride + kernel - size, 0) // 2
        pads.append((before, (count - 1 + blocks) * stride - size - before, 0))
        counts.append(count)
    # lax.pad, because the far end may lose pixels that no kernel reaches.
    x = jax.lax.pad(x, jnp.zeros((), x.dtype), ((0, 0, 0), *pads, (0, 0, 0)))
    height, width = (count - 1 + blocks for count in counts)
    x = x.reshape(batch, height, stride, width, stride, channels).transpose(0, 1, 3, 2, 4, 5)
    x = x.reshape(batch, height, width, stride * stride * channels)
    rows = [
        x[:, i : i + counts[0], j : j + counts[1]] for i in range(blocks) for j in range(blocks)
    ]
    return jnp.concatenate(rows, axis=-1)


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
            x = nn.relu(PatchConv(width, kernel, stride)(x))
            if layer < len(self.widths) - 1:
                x = max_pool(x, self.pool)
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
