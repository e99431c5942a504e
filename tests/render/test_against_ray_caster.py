"""Geom ids and depths against MuJoCo's C ray caster, which needs no OpenGL."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from mujoco_reference import at, cast_camera, geom_poses, random_qpos, shaded

from mjx_arm import make_renderer, rgb, segmentation
from mjx_arm.scene import Scene

POSES = 50
# Pixels whose ray passes an edge within float32 rounding.
MAX_MISMATCH = 0.0002
# Depths of about 1 m in float32, but for rays that graze a round body.
MAX_DEPTH_P99 = 1e-4
# Of 255: the geom's own colour is rounded, then the lit one; silhouettes bend away faster.
MAX_LEVELS = 2.0


@pytest.mark.parametrize("size", [(64, 64), (128, 128)])
@pytest.mark.parametrize("name", ["arm", "primitives"])
def test_geom_ids_and_depths_match(
    name: str, size: tuple[int, int], request: pytest.FixtureRequest
) -> None:
    scene: Scene = request.getfixturevalue(name)
    model = scene.mj_model
    qposes = random_qpos(model, POSES, seed=1)
    render = jax.jit(jax.vmap(make_renderer(scene, size=size, depth=True)))
    packed, depth = render(*geom_poses(model, qposes))
    geom = np.asarray(segmentation(packed))
    truth = [cast_camera(model, at(model, qpos), "front", size) for qpos in qposes]
    true_geom, true_depth, _ = (np.stack(part) for part in zip(*truth, strict=True))

    assert np.mean(geom != true_geom) <= MAX_MISMATCH
    agree = (geom == true_geom) & (geom >= 0)
    error = np.abs(np.asarray(depth) - true_depth)[agree]
    assert np.percentile(error, 99) < MAX_DEPTH_P99
    assert np.array_equal(np.isinf(depth), geom < 0)


def test_shading_follows_the_normals(primitives: Scene) -> None:
    model = primitives.mj_model
    size = (64, 64)
    qposes = random_qpos(model, 10, seed=4)
    packed = jax.vmap(make_renderer(primitives, size=size))(*geom_poses(model, qposes))
    states = [at(model, qpos) for qpos in qposes]
    truth = [cast_camera(model, data, "front", size) for data in states]
    geom, _, normal = (np.stack(part) for part in zip(*truth, strict=True))
    expected = shaded(model, states[0], "front", geom, normal)
    error = np.abs(np.asarray(rgb(packed)) - expected)[np.asarray(segmentation(packed)) == geom]
    assert np.percentile(error, 99.9) < MAX_LEVELS


@pytest.mark.parametrize("name", ["arm", "primitives"])
def test_the_poses_show_most_of_the_scene(name: str, request: pytest.FixtureRequest) -> None:
    scene: Scene = request.getfixturevalue(name)
    model = scene.mj_model
    packed = jax.vmap(make_renderer(scene))(*geom_poses(model, random_qpos(model, POSES, seed=1)))
    seen = set(np.unique(segmentation(packed))) - {-1}
    shown = {i for i in range(model.ngeom) if model.geom_group[i] < 3}
    transparent = {i for i in range(model.ngeom) if model.geom_rgba[i, 3] == 0}
    assert seen == shown - transparent


def test_a_wide_image_has_square_pixels(primitives: Scene) -> None:
    model = primitives.mj_model
    size = (40, 90)
    qpos = random_qpos(model, 1, seed=3)
    xpos, xmat = geom_poses(model, qpos)
    geom = np.asarray(segmentation(make_renderer(primitives, size=size)(xpos[0], xmat[0])))
    true_geom, _, _ = cast_camera(model, at(model, qpos[0]), "front", size)
    assert geom.shape == size
    assert np.mean(geom != true_geom) <= MAX_MISMATCH
