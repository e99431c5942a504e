"""Anti-aliasing, and what a camera does to an image."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mujoco_reference import at, random_qpos

from mjx_arm import make_renderer, rgb, segmentation
from mjx_arm.render.packing import NO_GEOM, pack
from mjx_arm.render.pixels import average, blur
from mjx_arm.render.sensor import entropy_of, make_sensor
from mjx_arm.scene import Scene

NOISY = {"image_noise": (0,), "image_seed": (0,)}


def random_image(seed: int = 0, size: tuple[int, int] = (32, 48)) -> jax.Array:
    rng = np.random.default_rng(seed)
    channels = [jnp.asarray(rng.integers(0, 256, size), jnp.uint32) for _ in range(3)]
    return pack(*channels, jnp.asarray(rng.integers(0, 20, size), jnp.uint32))


def levels(packed: jax.Array) -> np.ndarray:
    return np.asarray(rgb(packed)).astype(int)


def grey(level: int, size: tuple[int, int] = (64, 64), geom: int = 3) -> jax.Array:
    full = [jnp.full(size, value, jnp.uint32) for value in (level, level, level, geom)]
    return pack(*full)


@pytest.mark.parametrize("edge", [2, 4])
def test_averages_are_those_of_each_channel(edge: int) -> None:
    packed = random_image()
    blocks = levels(packed).reshape(32 // edge, edge, 48 // edge, edge, 3)
    np.testing.assert_allclose(levels(average(packed, edge)), blocks.mean(axis=(1, 3)), atol=0.5)
    ids = np.asarray(segmentation(packed))[edge // 2 :: edge, edge // 2 :: edge]
    np.testing.assert_array_equal(segmentation(average(packed, edge)), ids)


@pytest.mark.parametrize("samples", [4, pytest.param(16, marks=pytest.mark.slow)])
def test_several_samples_are_the_mean_of_a_larger_image(arm: Scene, samples: int) -> None:
    edge = {4: 2, 16: 4}[samples]
    data = at(arm.mj_model, random_qpos(arm.mj_model, 1, seed=1)[0])
    poses = (data.geom_xpos, data.geom_xmat)
    packed, depth = make_renderer(arm, size=(32, 32), samples=samples, depth=True)(*poses)
    large, far = make_renderer(arm, size=(32 * edge, 32 * edge), depth=True)(*poses)
    np.testing.assert_array_equal(packed, average(large, edge))
    np.testing.assert_array_equal(depth, far[edge // 2 :: edge, edge // 2 :: edge])
    plain = make_renderer(arm, size=(32, 32), samples=samples)(*poses)
    np.testing.assert_array_equal(plain, packed)


@pytest.mark.parametrize("samples", [0, 2, 9, True, 4.5, "4"])
def test_other_numbers_of_samples_are_rejected(arm: Scene, samples) -> None:
    with pytest.raises(ValueError, match="samples must be 1, 4 or 16 rays through a pixel, got"):
        make_renderer(arm, samples=samples)


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_blur_mixes_with_neighbours(share: float) -> None:
    packed = random_image()
    image = levels(packed)
    padded = np.pad(image, ((1, 1), (1, 1), (0, 0)), mode="edge").astype(float)
    rows = (padded[:-2] + 2 * padded[1:-1] + padded[2:]) / 4
    soft = (rows[:, :-2] + 2 * rows[:, 1:-1] + rows[:, 2:]) / 4
    blurred = levels(blur(packed, jnp.float32(share)))
    # Each of the four means rounds down.
    np.testing.assert_allclose(blurred, (1 - share) * image + share * soft, atol=2.5)
    np.testing.assert_array_equal(
        segmentation(blur(packed, jnp.float32(share))), segmentation(packed)
    )
    if share == 0:
        np.testing.assert_array_equal(blurred, image)


def test_gain_is_of_each_channel_and_saturates() -> None:
    sensor = make_sensor({"image_gain": (0,)})
    params = {"image_gain": jnp.asarray([[0.5, 1.0, 1.5]])}
    image = levels(sensor(grey(180), params, jnp.uint32(0)))
    np.testing.assert_array_equal(image[0, 0], [90, 180, 255])


@pytest.mark.parametrize("deviation", [0.0, 1.0, 4.0, 8.0])
def test_noise_has_its_deviation_and_no_pattern(deviation: float) -> None:
    sensor = make_sensor(NOISY)
    params = {"image_noise": jnp.full(1, deviation), "image_seed": jnp.full(1, 0.3)}
    image = grey(128)
    noise = levels(sensor(image, params, jnp.uint32(7))) - 128
    # Rounding adds the variance of 1/12.
    expected = np.sqrt(deviation**2 + (1 / 12 if deviation else 0))
    assert np.std(noise) == pytest.approx(expected, rel=0.05, abs=0.02)
    assert abs(noise.mean()) < 0.15
    if deviation:
        flat = noise.reshape(-1, 3)
        across = [np.corrcoef(flat[:, i], flat[:, j])[0, 1] for i, j in ((0, 1), (1, 2))]
        along = [np.corrcoef(flat[:-k, 0], flat[k:, 0])[0, 1] for k in (1, 64)]
        assert np.max(np.abs(across + along)) < 0.06


def test_noise_follows_from_seed_and_state() -> None:
    sensor = make_sensor(NOISY)
    image = grey(128, (8, 8))

    def noise(seed: float, entropy: jax.Array) -> np.ndarray:
        params = {"image_noise": jnp.full(1, 4.0), "image_seed": jnp.full(1, seed)}
        return np.asarray(sensor(image, params, entropy))

    qpos = jnp.linspace(0.0, 1.0, 15, dtype=jnp.float32)
    one = noise(0.25, entropy_of(qpos, 0))
    np.testing.assert_array_equal(one, noise(0.25, entropy_of(qpos, 0)))
    others = [
        noise(0.2500001, entropy_of(qpos, 0)),
        noise(0.25, entropy_of(qpos, 1)),
        noise(0.25, entropy_of(qpos.at[3].add(1e-6), 0)),
        noise(0.25, entropy_of(qpos[::-1], 0)),
    ]
    for other in others:
        assert np.mean(one != other) > 0.9


def test_the_background_is_what_hits_nothing() -> None:
    sensor = make_sensor({"image_background": (0,)})
    image = jnp.where(jnp.arange(64) < 32, grey(50), grey(0, geom=NO_GEOM))
    params = {"image_background": jnp.asarray([[0.2, 0.4, 1.0]])}
    shown = sensor(image, params, jnp.uint32(0))
    np.testing.assert_array_equal(shown[:, :32], image[:, :32])
    np.testing.assert_array_equal(levels(shown)[0, -1], [51, 102, 254])
    np.testing.assert_array_equal(segmentation(shown)[:, 32:], -1)


def test_white_noise_never_is_the_one_impossible_pixel() -> None:
    sensor = make_sensor({"image_background": (0,), "image_gain": (0,)})
    params = {"image_background": jnp.ones((1, 3)), "image_gain": jnp.full((1, 3), 2.0)}
    shown = sensor(grey(0, geom=NO_GEOM), params, jnp.uint32(0))
    assert not np.any(np.asarray(shown) == 0xFFFFFFFF)


def test_nothing_varies_nothing_is_done() -> None:
    assert make_sensor({}) is None
    assert make_sensor({"image_seed": (0,), "image_delay": (0,), "geom_rgba": (1,)}) is None


def test_shadows_of_an_episode_can_be_switched_off(arm: Scene) -> None:
    data = at(arm.mj_model, random_qpos(arm.mj_model, 1, seed=2)[0])
    poses = (data.geom_xpos, data.geom_xmat)
    render = make_renderer(arm, size=(48, 48), shadows=True, varies={"light_shadow": (0,)})
    for on, shadows in ((0.0, False), (1.0, True)):
        image = render(*poses, {"light_shadow": jnp.full(1, on)})
        plain = make_renderer(arm, size=(48, 48), shadows=shadows)(*poses)
        np.testing.assert_array_equal(image, plain)
