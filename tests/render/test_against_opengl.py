"""Geom ids and colours against MuJoCo's own renderer."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco_reference import at, geom_poses, random_primitives, random_qpos, wrist_scene

from mjx_arm import make_renderer, rgb, segmentation
from mjx_arm.kinematics import make_camera_pose
from mjx_arm.scene import Scene, load_scene

POSES = 50
# OpenGL renders round bodies as polyhedra and rounds coordinates to subpixels.
MAX_MISMATCH = 0.0015
MIN_CUBE_IOU = 0.99
# OpenGL smooths edges and the borders of shadows; the mean of all channels and pixels, of 255.
MAX_RGB_ERROR = 3.0
# Away from edges nothing is smoothed: rounding, and colours interpolated between vertices.
MAX_INTERIOR_ERROR = 1.0

pytestmark = pytest.mark.usefixtures("opengl")


@contextmanager
def _opengl(scene: Scene, size: tuple[int, int]) -> Iterator[mujoco.Renderer]:
    renderer = mujoco.Renderer(scene.mj_model, *size)
    try:
        yield renderer
    finally:
        renderer.close()


def _opengl_geoms(
    scene: Scene, qposes: np.ndarray, size: tuple[int, int], camera: str = "front"
) -> np.ndarray:
    images = []
    with _opengl(scene, size) as renderer:
        renderer.enable_segmentation_rendering()
        for qpos in qposes:
            renderer.update_scene(at(scene.mj_model, qpos), camera)
            ids, kinds = np.moveaxis(renderer.render(), -1, 0)
            images.append(np.where(kinds == mujoco.mjtObj.mjOBJ_GEOM, ids, -1))
    return np.stack(images)


def _opengl_rgb(
    scene: Scene, qposes: np.ndarray, size: tuple[int, int], shadows: bool
) -> np.ndarray:
    images = []
    with _opengl(scene, size) as renderer:
        renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = shadows
        for qpos in qposes:
            renderer.update_scene(at(scene.mj_model, qpos), "front")
            images.append(renderer.render())
    return np.stack(images).astype(float)


def _interior(geom: np.ndarray) -> np.ndarray:
    """Pixels `[N, H, W]` whose eight neighbours show the same geom."""
    inside = np.zeros(geom.shape, bool)
    centre = geom[:, 1:-1, 1:-1]
    same = np.ones(centre.shape, bool)
    height, width = geom.shape[1:]
    for dy in range(3):
        for dx in range(3):
            same &= geom[:, dy : height - 2 + dy, dx : width - 2 + dx] == centre
    inside[:, 1:-1, 1:-1] = same
    return inside


@pytest.mark.parametrize("size", [(64, 64), (128, 128)])
def test_geom_ids_match_on_the_arm(arm: Scene, size: tuple[int, int]) -> None:
    model = arm.mj_model
    qposes = random_qpos(model, POSES, seed=2)
    packed = jax.jit(jax.vmap(make_renderer(arm, size=size)))(*geom_poses(model, qposes))
    geom = np.asarray(segmentation(packed))
    truth = _opengl_geoms(arm, qposes, size)
    cube = model.geom("cube").id
    both, either = (geom == cube) & (truth == cube), (geom == cube) | (truth == cube)
    assert np.mean(geom != truth) <= MAX_MISMATCH
    assert both.sum() >= MIN_CUBE_IOU * either.sum() > 0


def test_geom_ids_match_through_a_wrist_camera() -> None:
    scene, size = wrist_scene(), (64, 64)
    model = scene.mj_model
    qposes = random_qpos(model, 20, seed=6)
    camera = jax.vmap(make_camera_pose(model, "wrist"))(jnp.asarray(qposes, jnp.float32))
    render = jax.jit(jax.vmap(make_renderer(scene, camera="wrist", size=size)))
    packed = render(*geom_poses(model, qposes), {}, camera)
    geom, truth = np.asarray(segmentation(packed)), _opengl_geoms(scene, qposes, size, "wrist")
    # Bodies at a few centimetres: their polyhedra differ more from round shapes.
    assert np.mean(geom != truth) <= 3 * MAX_MISMATCH
    assert len(np.unique(truth)) > 4


LAMPS = """
<light type="directional" pos="1 -1 2" dir="-0.6 0.5 -1" diffuse="0.4 0.2 0.6" specular="0 0 0"/>
<light type="directional" dir="0.1 0.7 -1" diffuse="0.2 0.3 0.1" specular="0 0 0"
       castshadow="false"/>"""


@pytest.fixture(scope="module")
def lamps() -> Scene:
    return random_primitives(seed=0, count=4, lights=LAMPS)


@pytest.mark.parametrize("shadows", [False, True])
@pytest.mark.parametrize(("name", "poses"), [("arm", POSES), ("primitives", 10), ("lamps", 10)])
def test_colours_match(
    name: str, poses: int, shadows: bool, request: pytest.FixtureRequest
) -> None:
    scene: Scene = request.getfixturevalue(name)
    size = (64, 64)
    qposes = random_qpos(scene.mj_model, poses, seed=3)
    render = jax.jit(jax.vmap(make_renderer(scene, size=size, shadows=shadows)))
    packed = render(*geom_poses(scene.mj_model, qposes))
    error = np.abs(np.asarray(rgb(packed), float) - _opengl_rgb(scene, qposes, size, shadows))
    assert error.mean() < MAX_RGB_ERROR
    if not shadows:
        interior = _interior(np.asarray(segmentation(packed)))
        assert error[interior].mean() < MAX_INTERIOR_ERROR


DESK_POSES = 40


@pytest.mark.parametrize("shadows", [False, True])
def test_the_desk_matches(shadows: bool) -> None:
    """Textures, two lights and the wall: the median of all channels and pixels, of 255."""
    scene, size = load_scene("arm_cube_desk"), (64, 64)
    qposes = random_qpos(scene.mj_model, DESK_POSES, seed=8)
    render = jax.jit(jax.vmap(make_renderer(scene, size=size, shadows=shadows)))
    packed = render(*geom_poses(scene.mj_model, qposes))
    truth = _opengl_rgb(scene, qposes, size, shadows)
    error = np.abs(np.asarray(rgb(packed), float) - truth)
    assert np.median(error) < 3
    assert error.mean() < 2 * MAX_RGB_ERROR
    # Its textures are seen: neighbours on the table differ.
    table = np.asarray(segmentation(packed)) == scene.mj_model.geom("table").id
    assert np.std(truth[table]) > 5


def test_several_samples_come_closer_to_smoothed_edges(arm: Scene) -> None:
    size = (64, 64)
    qposes = random_qpos(arm.mj_model, 10, seed=9)
    truth = _opengl_rgb(arm, qposes, size, shadows=False)
    errors = []
    for samples in (1, 4):
        render = jax.jit(jax.vmap(make_renderer(arm, size=size, samples=samples)))
        image = np.asarray(rgb(render(*geom_poses(arm.mj_model, qposes))), float)
        errors.append(np.abs(image - truth).mean())
    assert errors[1] < 0.7 * errors[0]
