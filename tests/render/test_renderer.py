from __future__ import annotations

import re
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mujoco_reference import at, geom_poses, random_qpos

from mjx_arm import make_renderer, rgb
from mjx_arm.scene import Scene


def test_shapes_and_dtypes(arm: Scene) -> None:
    data = at(arm.mj_model)
    packed = make_renderer(arm)(data.geom_xpos, data.geom_xmat)
    assert (packed.shape, packed.dtype) == ((64, 64), jnp.uint32)
    packed, depth = make_renderer(arm, size=(24, 48), depth=True)(data.geom_xpos, data.geom_xmat)
    assert (packed.shape, packed.dtype) == ((24, 48), jnp.uint32)
    assert (depth.shape, depth.dtype) == ((24, 48), jnp.float32)


@pytest.mark.usefixtures("optimised")
def test_depth_and_flat_matrices_do_not_change_the_image(arm: Scene) -> None:
    data = at(arm.mj_model, random_qpos(arm.mj_model, 1, seed=14)[0])
    plain = make_renderer(arm)(data.geom_xpos, data.geom_xmat.reshape(-1, 3, 3))
    packed, _ = make_renderer(arm, depth=True)(data.geom_xpos, data.geom_xmat)
    np.testing.assert_array_equal(packed, plain)


@pytest.mark.parametrize(
    "size", [(0, 64), (64, -1), (64,), (64, 64, 3), 64, (64.0, 64.0), "64", None]
)
def test_a_bad_size_is_named(arm: Scene, size: Any) -> None:
    with pytest.raises(ValueError, match=re.escape(f"size={size!r}")):
        make_renderer(arm, size=size)


def test_an_unknown_camera_is_named(arm: Scene) -> None:
    with pytest.raises(ValueError, match=r"unknown camera 'side'.*'front'"):
        make_renderer(arm, camera="side")


def test_a_batch_without_vmap_is_rejected(arm: Scene) -> None:
    xpos, xmat = geom_poses(arm.mj_model, random_qpos(arm.mj_model, 2, seed=15))
    with pytest.raises(ValueError, match=r"geom_xpos \[2, .*jax.vmap"):
        make_renderer(arm)(xpos, xmat)


def test_poses_of_static_and_hidden_geoms_are_ignored(primitives: Scene) -> None:
    model = primitives.mj_model
    data = at(model, random_qpos(model, 1, seed=16)[0])
    render = make_renderer(primitives)
    expected = render(data.geom_xpos, data.geom_xmat)
    world = model.geom_bodyid == 0
    moved = np.where(world[:, None], np.nan, data.geom_xpos)
    np.testing.assert_array_equal(render(moved, data.geom_xmat), expected)


def test_compiles_once(arm: Scene) -> None:
    xpos, xmat = geom_poses(arm.mj_model, random_qpos(arm.mj_model, 3, seed=17))
    render = make_renderer(arm, size=(8, 8))
    for pose in zip(xpos, xmat, strict=True):
        render(*pose)
    assert render._cache_size() == 1


def test_a_renderer_can_be_made_inside_of_a_trace(arm: Scene) -> None:
    data = at(arm.mj_model)

    @jax.jit
    def frame(xpos: jax.Array, xmat: jax.Array) -> jax.Array:
        return make_renderer(arm, size=(8, 8))(xpos, xmat)

    expected = make_renderer(arm, size=(8, 8))(data.geom_xpos, data.geom_xmat)
    np.testing.assert_array_equal(frame(data.geom_xpos, data.geom_xmat), expected)


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="concerns XLA's fusion on CPU")
@pytest.mark.parametrize("depth", [False, True])
def test_the_ray_cast_is_not_fused_into_its_consumers(arm: Scene, depth: bool) -> None:
    """XLA would repeat it for every channel: 35 times slower, and nothing else would tell."""
    xpos, xmat = geom_poses(arm.mj_model, random_qpos(arm.mj_model, 2, seed=18))
    frame = jax.vmap(make_renderer(arm, size=(8, 8), depth=depth))

    def colours(xpos: jax.Array, xmat: jax.Array) -> jax.Array:
        image = frame(xpos, xmat)
        return rgb(image[0] if depth else image)

    program = jax.jit(colours).lower(xpos, xmat).compile().as_text()
    kernels = program.split("\n\n")
    # Roots stand for the ray cast, bytes for the colours.
    casting = [kernel for kernel in kernels if " sqrt(" in kernel]
    assert casting
    assert any(" u8[" in kernel for kernel in kernels)
    assert not any(" u8[" in kernel for kernel in casting)
