"""What a camera does to an image: blur, exposure and noise.

All in whole numbers, which are the same on every device.
"""

from __future__ import annotations

import math
from typing import Protocol

import jax
import jax.numpy as jnp

from mjx_arm.render.packing import NO_GEOM, pack, unpack
from mjx_arm.render.pixels import blur
from mjx_arm.varies import Params, Varies

SENSOR_FIELDS = ("image_background", "image_blur", "image_gain", "image_noise")
"""Fields of which a sensor is made; the noise also reads `image_seed`."""

# The noise of a channel is the sum of two of these many equally likely numbers.
_STEPS = 32
_STANDARD_DEVIATION = math.sqrt(2 * (_STEPS**2 - 1) / 12)
_GOLDEN = 0x9E3779B9


class Sensor(Protocol):
    """`(packed [H, W] uint32, params, entropy [] uint32) -> [H, W] uint32`; see `make_sensor`."""

    def __call__(self, packed: jax.Array, params: Params, entropy: jax.Array) -> jax.Array:
        """Returns the image as the camera delivers it."""
        ...


def make_sensor(varies: Varies) -> Sensor | None:
    """Makes the function that turns a rendered image into what a camera delivers.

    Its arguments are packed pixels, the params of the episode, and whole numbers that differ from
    frame to frame, from which the noise is made: the same arguments give the same noise. Geom ids
    are left as they are. First the pixels that hit nothing get the colour `image_background`; then
    come blur, gain and noise. The noise of each channel has a triangular distribution.

    Args:
      varies: names of `SENSOR_FIELDS` are read, the others ignored.

    Returns:
      The function, or None where nothing of it varies.
    """
    active = [field for field in SENSOR_FIELDS if varies.get(field)]
    if not active:
        return None

    def sensor(packed: jax.Array, params: Params, entropy: jax.Array) -> jax.Array:
        if "image_background" in active:
            packed = _fill_background(packed, params["image_background"][0])
        if "image_blur" in active:
            packed = blur(packed, params["image_blur"][0])
        if "image_gain" not in active and "image_noise" not in active:
            return packed
        gain = params["image_gain"][0] if "image_gain" in active else jnp.ones(3, jnp.float32)
        noise = None
        if "image_noise" in active:
            noise = params["image_noise"][0], _seed(params) + entropy
        return _expose(packed, gain, noise)

    return sensor


def entropy_of(qpos: jax.Array, camera: int) -> jax.Array:
    """Whole numbers that differ between two states, and between two cameras, `[] uint32`.

    Made of the bits of `qpos [nq] float32`, so that a stored state gives its noise again.
    """
    bits = jax.lax.bitcast_convert_type(qpos, jnp.uint32)
    place = jnp.arange(1 + len(bits), dtype=jnp.uint32) * jnp.uint32(_GOLDEN)
    words = jnp.concatenate([jnp.full((1,), camera, jnp.uint32), bits])
    return jnp.sum(_mix(words + place), dtype=jnp.uint32)


def _seed(params: Params) -> jax.Array:
    if "image_seed" not in params:
        return jnp.zeros((), jnp.uint32)
    return jax.lax.bitcast_convert_type(params["image_seed"][0], jnp.uint32)


def _mix(words: jax.Array) -> jax.Array:
    """Bits of which each depends on all bits of a word: Wellons' hash `lowbias32`."""
    words = (words ^ (words >> 16)) * jnp.uint32(0x7FEB352D)
    words = (words ^ (words >> 15)) * jnp.uint32(0x846CA68B)
    return words ^ (words >> 16)


def _fill_background(packed: jax.Array, colour: jax.Array) -> jax.Array:
    # Of white with the id of nothing, `materialize` would not know that it is a pixel.
    levels = jnp.round(jnp.clip(colour, 0.0, 254 / 255) * 255).astype(jnp.uint32)
    filled = pack(levels[0], levels[1], levels[2], jnp.uint32(NO_GEOM))
    return jnp.where((packed >> 24) == NO_GEOM, filled, packed)


def _expose(
    packed: jax.Array, gain: jax.Array, noise: tuple[jax.Array, jax.Array] | None
) -> jax.Array:
    """Multiplies channels by `gain [3]`, and adds noise of a standard deviation from a seed."""
    *channels, geom = unpack(packed)
    # Levels in 256ths.
    factors = jnp.round(gain * 256).astype(jnp.int32)
    values = [
        channel.astype(jnp.int32) * factor
        for channel, factor in zip(channels, factors, strict=True)
    ]
    if noise is not None:
        deviation, seed = noise
        size = jnp.round(deviation * (256 / _STANDARD_DEVIATION)).astype(jnp.int32)
        pixels = jnp.arange(packed.size, dtype=jnp.uint32).reshape(packed.shape)
        bits = _mix(pixels * jnp.uint32(_GOLDEN) + _mix(seed))
        for i in range(3):
            pair = [(bits >> (10 * i + shift)) & (_STEPS - 1) for shift in (0, 5)]
            deviate = (pair[0] + pair[1]).astype(jnp.int32) - (_STEPS - 1)
            values[i] = values[i] + size * deviate
    red, green, blue = (jnp.clip((value + 128) >> 8, 0, 255).astype(jnp.uint32) for value in values)
    # Noise can make white of the background, which no pixel may be; see above.
    blue = jnp.where(geom == NO_GEOM, jnp.minimum(blue, jnp.uint32(254)), blue)
    return pack(red, green, blue, geom)
