"""Views that break careless ray casters."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mujoco_reference import at, cast_rays, geom_poses, pixel_rays, random_qpos, scene_of

from mjx_arm import make_renderer, rgb, segmentation
from mjx_arm.scene import Scene

SIZE = (32, 32)
FOVY = 70.0
# In float32, of the pixels of many close views.
MAX_MISMATCH = 0.0005
# Relative, since close views have depths from millimetres up.
MAX_DEPTH_P99 = 1e-4

# Slim shapes, so that the bounding sphere is mostly empty.
SHAPES = {
    "box": "0.02 0.1 0.3",
    "sphere": "0.2 0 0",
    "capsule": "0.03 0.3 0",
    "cylinder": "0.03 0.3 0",
    "disc": "0.3 0.02 0",
    "plane": "0.3 0.1 0.1",
}


def _one_geom(shape: str, extra: str = "") -> Scene:
    kind = "cylinder" if shape == "disc" else shape
    return scene_of(f"""
<mujoco>
  <worldbody>
    <light type="directional" dir="0.3 0.2 -1"/>
    <camera name="front" pos="0 0 2"/>
    <geom type="{kind}" size="{SHAPES[shape]}" {extra}/>
  </worldbody>
</mujoco>""")


def _look(
    scene: Scene, pos: np.ndarray, mat: np.ndarray, shadows: bool = False
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Colours, geom ids and depths of N views from `pos [N, 3]` with axes `mat [N, 3, 3]`."""
    params = {"cam_fovy": jnp.full(1, FOVY, jnp.float32)}
    data = at(scene.mj_model)
    render = make_renderer(scene, size=SIZE, shadows=shadows, depth=True, varies={"cam_fovy": (0,)})
    views = jax.jit(jax.vmap(render, in_axes=(None, None, None, 0)))
    packed, depth = views(data.geom_xpos, data.geom_xmat, params, (pos, mat))
    return np.asarray(rgb(packed)), np.asarray(segmentation(packed)), np.asarray(depth)


def _truth(scene: Scene, pos: np.ndarray, mat: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    data = at(scene.mj_model)
    views = [
        cast_rays(scene.mj_model, data, np.float64(p), pixel_rays(m, FOVY, SIZE))[:2]
        for p, m in zip(pos, mat, strict=True)
    ]
    geom, depth = zip(*views, strict=True)
    return np.stack(geom), np.stack(depth)


def _looking_at(pos: np.ndarray, target: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Camera axes `[N, 3, 3]` in columns, with a random roll."""
    backward = pos - target
    backward /= np.linalg.norm(backward, axis=-1, keepdims=True)
    right = np.cross(rng.normal(size=pos.shape), backward)
    right /= np.linalg.norm(right, axis=-1, keepdims=True)
    return np.stack([right, np.cross(backward, right), backward], axis=-1)


def _assert_same(scene: Scene, pos: np.ndarray, mat: np.ndarray) -> None:
    _, geom, depth = _look(scene, pos, mat)
    true_geom, true_depth = _truth(scene, pos, mat)
    assert np.mean(geom != true_geom) <= MAX_MISMATCH
    agree = (geom == true_geom) & (geom >= 0)
    assert np.array_equal(np.isinf(depth), geom < 0)
    if agree.any():
        error = np.abs(depth[agree] / true_depth[agree] - 1)
        assert np.percentile(error, 99) < MAX_DEPTH_P99


def _outside(scene: Scene, pos: np.ndarray) -> np.ndarray:
    """Whether points are outside of the only geom; a geom around the camera is not rendered."""
    data = at(scene.mj_model)
    normals = np.concatenate([np.eye(3), -np.eye(3)])
    geoms = [cast_rays(scene.mj_model, data, p, normals)[0] for p in pos]
    return ~np.all(np.stack(geoms) >= 0, axis=1)


@pytest.mark.parametrize("shape", SHAPES)
def test_camera_inside_the_bounding_sphere(shape: str) -> None:
    rng = np.random.default_rng(5)
    scene = _one_geom(shape)
    pos = rng.uniform(-0.2, 0.2, (200, 3))
    if shape == "sphere":
        pos = pos / np.linalg.norm(pos, axis=-1, keepdims=True) * rng.uniform(0.201, 0.25, (200, 1))
    pos = pos[_outside(scene, pos)].astype(np.float32)
    target = rng.uniform(-0.2, 0.2, pos.shape)
    assert len(pos) > 100
    _assert_same(scene, pos, _looking_at(pos.astype(float), target, rng).astype(np.float32))


@pytest.mark.parametrize("shape", SHAPES)
def test_geoms_behind_the_camera(shape: str) -> None:
    rng = np.random.default_rng(6)
    scene = _one_geom(shape)
    pos = rng.normal(size=(50, 3))
    pos /= np.linalg.norm(pos, axis=-1, keepdims=True)
    mat = _looking_at(pos, 2 * pos, rng)
    colours, geom, depth = _look(scene, pos, mat)
    assert np.all(geom == -1)
    assert np.all(colours == 0)
    assert np.all(np.isposinf(depth))


@pytest.mark.parametrize("shape", ["box", "sphere", "capsule", "cylinder"])
def test_a_geom_around_the_camera_is_not_rendered(shape: str) -> None:
    scene = _one_geom(shape)
    pos = np.asarray([[0.0, 0.0, 0.0], [0.005, -0.01, 0.05], [0.0, 0.0, -0.19]])
    mat = _looking_at(pos, pos + np.asarray([1.0, 0.3, 0.2]), np.random.default_rng(0))
    assert np.all(_look(scene, pos, mat)[1] == -1)


def test_a_dome_around_the_scene_is_not_rendered() -> None:
    scene = scene_of("""
<mujoco>
  <worldbody>
    <camera name="front" pos="0 0 0"/>
    <geom type="sphere" size="5"/>
    <geom type="sphere" size="0.1" pos="1 0 0"/>
  </worldbody>
</mujoco>""")
    pos = np.asarray([[0.0, 0.0, 0.0], [0.5, 0.3, -0.2], [-2.0, 0.0, 0.0]])
    mat = _looking_at(pos, np.asarray([[1.0, 0.0, 0.0]]), np.random.default_rng(0))
    geom = _look(scene, pos, mat)[1]
    assert not np.any(geom == 0)
    assert np.all(np.any(geom == 1, axis=(1, 2)))


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("distance", [0.35, 0.5, 0.7, 3.0])
def test_camera_on_the_axes_of_symmetry(shape: str, distance: float) -> None:
    scene = _one_geom(shape)
    pos = distance * np.concatenate([np.eye(3), -np.eye(3)])
    _assert_same(scene, pos, _looking_at(pos, np.zeros((6, 3)), np.random.default_rng(7)))


@pytest.mark.parametrize("shape", ["box", "cylinder", "capsule", "plane"])
def test_grazing_rays(shape: str) -> None:
    """Cameras in the planes and tangents of faces: finite, and right off the grazed face."""
    scene = _one_geom(shape)
    half = scene.mj_model.geom_size[0]
    top = {"box": half[2], "plane": 0.0}.get(shape, half[1])
    side = half[0]
    pos = np.asarray([[0.8, 0.0, top], [0.0, 0.9, -top], [side, 0.6, 0.0], [side, 0.0, 0.9]])
    target = np.asarray([[0.0, 0.0, top], [0.0, 0.0, -top], [side, 0.0, 0.0], [side, 0.0, 0.0]])
    pos, target = pos.astype(np.float32).astype(float), target.astype(np.float32).astype(float)
    mat = _looking_at(pos, target, np.random.default_rng(8))
    colours, geom, depth = _look(scene, pos, mat, shadows=True)
    true_geom, true_depth = _truth(scene, pos, mat)
    # A face that is seen exactly edge-on may show in the pixels on its line.
    wrong = geom != true_geom
    assert wrong.mean() < 0.02
    agree = ~wrong & (geom >= 0)
    assert np.percentile(np.abs(depth[agree] - true_depth[agree]), 99) < MAX_DEPTH_P99
    assert np.all(depth > 0)
    assert np.all(colours[geom < 0] == 0)


def test_a_floor_up_to_the_horizon() -> None:
    scene = scene_of("""
<mujoco>
  <worldbody>
    <camera name="front" pos="0 0 0.3" xyaxes="1 0 0 0 0 1" fovy="70"/>
    <geom type="plane" size="0 0 1"/>
  </worldbody>
</mujoco>""")
    pos = np.asarray([[0.0, 0.0, 0.3]])
    mat = np.asarray([[[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]])
    _, geom, depth = _look(scene, pos, mat)
    assert np.all(geom[0, : SIZE[0] // 2] == -1)
    assert np.all(geom[0, SIZE[0] // 2 :] == 0)
    _, true_depth = _truth(scene, pos, mat)
    np.testing.assert_allclose(depth, true_depth, rtol=1e-5)


def test_an_empty_scene_is_black() -> None:
    scene = scene_of('<mujoco><worldbody><camera name="front"/></worldbody></mujoco>')
    render = make_renderer(scene, shadows=True, depth=True)
    packed, depth = render(jnp.zeros((0, 3)), jnp.zeros((0, 3, 3)))
    assert packed.shape == (64, 64)
    assert np.all(segmentation(packed) == -1)
    assert np.all(np.asarray(rgb(packed)) == 0)
    assert np.all(np.isposinf(depth))


def test_nested_vmap_renders_the_same_frames(arm: Scene) -> None:
    model = arm.mj_model
    xpos, xmat = geom_poses(model, random_qpos(model, 6, seed=9))
    render = make_renderer(arm, size=SIZE, shadows=True)
    one_by_one = np.stack([render(p, m) for p, m in zip(xpos, xmat, strict=True)])
    nested = jax.vmap(jax.vmap(render), in_axes=(1, 0), out_axes=2)(
        jnp.moveaxis(xpos.reshape(2, 3, -1, 3), 0, 1), xmat.reshape(2, 3, -1, 3, 3)
    )
    nested = np.moveaxis(np.asarray(nested), 2, 0)
    np.testing.assert_array_equal(nested.reshape(6, *SIZE), one_by_one)
