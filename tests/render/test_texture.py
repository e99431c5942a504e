"""Textures: their mapping by hand, and against MuJoCo's own renderer."""

from __future__ import annotations

import copy
import io

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco_reference import at, scene_of
from PIL import Image

from mjx_arm import make_renderer, rgb, segmentation
from mjx_arm.scene import Scene, SceneSource, compile_scene, load_scene

RANDOM = np.random.default_rng(0).integers(0, 256, (8, 8, 3), dtype=np.uint8)


def png(image: np.ndarray) -> bytes:
    file = io.BytesIO()
    Image.fromarray(image).save(file, format="PNG")
    return file.getvalue()


def textured(world: str, assets: str, image: np.ndarray = RANDOM) -> Scene:
    xml = f"""
<mujoco>
  <compiler angle="degree"/>
  <visual>
    <headlight ambient="1 1 1" diffuse="0 0 0" specular="0 0 0"/>
    <map znear="0.005" zfar="50"/>
  </visual>
  <statistic center="0 0 0" extent="1"/>
  <asset>{assets}</asset>
  <worldbody>{world}</worldbody>
</mujoco>"""
    return compile_scene("test", SceneSource(xml, {"image.png": png(image)}))


def image_of(scene: Scene, size: tuple[int, int], **options) -> np.ndarray:
    data = at(scene.mj_model)
    packed = make_renderer(scene, size=size, **options)(data.geom_xpos, data.geom_xmat)
    return np.asarray(rgb(packed)).astype(int)


# From 1 m above it sees two metres.
ABOVE = '<camera name="front" pos="0 0 1" fovy="90"/>'
FLAT = '<texture name="t" type="2d" file="image.png" colorspace="linear"/>'


def turned(shift: tuple[int, int]) -> np.ndarray:
    return np.roll(RANDOM, shift, (0, 1))


@pytest.mark.parametrize(
    ("geom", "material", "expected"),
    [
        # Over the whole of a finite plane, the first row of the file at its far end.
        ('type="plane" size="1 1 1"', "", RANDOM),
        ('type="plane" size="1 1 1"', 'texrepeat="2 2"', np.tile(RANDOM, (2, 2, 1))),
        # By metres from the middle: one texture in two metres.
        ('type="plane" size="0 0 1"', "", RANDOM),
        ('type="plane" size="0 0 1"', 'texrepeat="2 2"', np.tile(turned((4, 4)), (2, 2, 1))),
        # Twice over four metres, of which the middle two are seen.
        ('type="plane" size="2 2 1"', 'texuniform="true"', turned((4, 4))),
        ('type="box" size="1 1 0.5" pos="0 0 -0.5"', "", RANDOM),
        ('type="box" size="2 2 0.5" pos="0 0 -0.5"', 'texuniform="true"', turned((4, 4))),
    ],
)
def test_a_2d_texture_by_hand(geom: str, material: str, expected: np.ndarray) -> None:
    scene = textured(
        f'{ABOVE}<geom {geom} material="m"/>', f'{FLAT}<material name="m" texture="t" {material}/>'
    )
    np.testing.assert_allclose(image_of(scene, expected.shape[:2]), expected, atol=1)


@pytest.mark.parametrize(
    ("camera", "right", "up"),
    [
        ('pos="1.5 0 0" xyaxes="0 1 0 0 0 1"', 1, 1),
        ('pos="-1.5 0 0" xyaxes="0 -1 0 0 0 1"', -1, 1),
        ('pos="0 -1.5 0" xyaxes="1 0 0 0 0 1"', 1, 1),
        ('pos="0 1.5 0" xyaxes="-1 0 0 0 0 1"', -1, 1),
        ('pos="0 0 -1.5" xyaxes="1 0 0 0 -1 0"', 1, -1),
    ],
)
def test_each_side_of_a_box_by_hand(camera: str, right: int, up: int) -> None:
    scene = textured(
        f'<camera name="front" {camera} fovy="90"/>'
        '<geom type="box" size="0.5 0.5 0.5" material="m"/>',
        f'{FLAT}<material name="m" texture="t"/>',
    )
    # The face is one metre from the camera and one metre wide, half of the image.
    image = image_of(scene, (16, 16))[4:12, 4:12]
    np.testing.assert_allclose(image, RANDOM[::up, ::right], atol=1)


def test_a_texture_multiplies_the_colour() -> None:
    scene = textured(
        f'{ABOVE}<geom type="plane" size="1 1 1" material="m"/>',
        f'{FLAT}<material name="m" texture="t" rgba="0.5 1 0.25 1"/>',
    )
    expected = RANDOM * np.asarray([0.5, 1.0, 0.25])
    np.testing.assert_allclose(image_of(scene, (8, 8)), expected, atol=1)


def test_far_away_a_texture_becomes_its_mean() -> None:
    scene = textured(
        '<camera name="front" pos="0 0 40" fovy="1"/>'
        '<geom type="plane" size="0 0 1" material="m"/>',
        f'{FLAT}<material name="m" texture="t" texrepeat="200 200"/>',
    )
    image = image_of(scene, (16, 16))
    mean = RANDOM.reshape(-1, 3).mean(axis=0)
    np.testing.assert_allclose(image, np.broadcast_to(mean, image.shape), atol=2)


def test_an_image_in_srgb_is_made_linear() -> None:
    scene = textured(
        f'{ABOVE}<geom type="plane" size="1 1 1" material="m"/>',
        f"{FLAT.replace('linear', 'sRGB')}<material name='m' texture='t'/>",
        np.full((8, 8, 3), 188, np.uint8),
    )
    np.testing.assert_allclose(image_of(scene, (8, 8)), 128, atol=1)


SIX = """
<texture name="t" type="cube" builtin="flat" width="16" height="96" rgb1="0.9 0.1 0.1"
         rgb2="0.1 0.2 0.9" mark="cross" markrgb="1 1 0"/>
<texture name="repeated" type="cube" file="image.png" colorspace="linear"/>
<texture name="flat" type="2d" file="image.png" colorspace="linear"/>
<material name="six" texture="t" specular="0"/>
<material name="same" texture="repeated" specular="0"/>
<material name="metric" texture="repeated" texuniform="true" specular="0"/>
<material name="sides" texture="flat" texrepeat="3 2" specular="0"/>
<material name="floor" texture="flat" texrepeat="1.5 0.5" rgba="0.8 0.9 1 1" specular="0"/>"""
BOXES = """
<camera name="front" pos="1.6 -1.1 1.4" xyaxes="0.57 0.82 0 -0.45 0.31 0.84" fovy="45"/>
<geom type="plane" size="0 0 1" material="floor"/>
<geom type="plane" size="0.8 1.2 1" pos="-1.4 0.6 0.8" euler="0 70 0" material="sides"/>
<geom type="box" size="0.3 0.2 0.25" pos="0.3 0.4 0.6" euler="20 30 50" material="six"/>
<geom type="box" size="0.25 0.2 0.3" pos="-0.5 0.3 0.5" euler="-30 60 10" material="same"/>
<geom type="box" size="0.3 0.25 0.2" pos="-0.2 -0.5 0.4" euler="70 20 -40" material="metric"/>
<geom type="box" size="0.2 0.15 0.12" pos="0.5 -0.3 0.3" euler="15 -30 80" material="sides"/>"""


@pytest.mark.usefixtures("opengl")
@pytest.mark.parametrize("view", [0, *(pytest.param(i, marks=pytest.mark.slow) for i in (1, 2, 3))])
def test_planes_and_boxes_match_opengl(view: int) -> None:
    scene, size = textured(BOXES, SIX), (128, 128)
    model = copy.copy(scene.mj_model)
    # Other sides of the boxes in each view.
    turn, still = np.zeros(4), model.geom_type != mujoco.mjtGeom.mjGEOM_PLANE
    mujoco.mju_axisAngle2Quat(turn, np.asarray([0.3, 1.0, 0.5]) / np.sqrt(1.34), 1.7 * view)
    for geom in np.flatnonzero(still):
        quat = model.geom_quat[geom].copy()
        mujoco.mju_mulQuat(model.geom_quat[geom], quat, turn)
    model.geom_sameframe[:] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE
    data = at(model)
    packed = make_renderer(model, size=size)(data.geom_xpos, data.geom_xmat)
    with mujoco.Renderer(model, *size) as renderer:
        renderer.update_scene(data, "front")
        truth = renderer.render().astype(float)
    error = np.abs(np.asarray(rgb(packed), float) - truth)
    ids = np.asarray(segmentation(packed))
    for geom in range(model.ngeom):
        # Noise of one texel to the next in all channels: the hardest case for interpolation.
        assert np.median(error[ids == geom]) < 6, model.geom_matid[geom]
        assert (ids == geom).sum() > 100
    assert np.median(error) < 3


def test_which_texture_and_how_often_vary() -> None:
    world = f'{ABOVE}<geom type="plane" size="1 1 1" material="m"/>'
    assets = f"""
<texture name="u" type="2d" builtin="checker" width="8" height="8" rgb1="0 0 0" rgb2="1 1 1"/>
{FLAT}<material name="m" texture="t"/>"""
    scene = textured(world, assets)
    model = scene.mj_model
    data = at(model)
    varies = {"mat_texture": (0,), "mat_texrepeat": (0,)}
    render = make_renderer(scene, size=(16, 16), varies=varies)
    for texture, repeat in ((0, 1.0), (1, 1.0), (1, 2.0), (0, 3.0)):
        edited = copy.copy(model)
        edited.mat_texid[0, mujoco.mjtTextureRole.mjTEXROLE_RGB] = texture
        edited.mat_texrepeat[0] = repeat
        params = {
            "mat_texture": jnp.full((1,), texture, jnp.float32),
            "mat_texrepeat": jnp.full((1, 2), repeat, jnp.float32),
        }
        varied = render(data.geom_xpos, data.geom_xmat, params)
        plain = make_renderer(edited, size=(16, 16))(data.geom_xpos, data.geom_xmat)
        levels = [np.asarray(rgb(image)).astype(int) for image in (varied, plain)]
        np.testing.assert_allclose(levels[0], levels[1], atol=1)


def test_a_moving_box_has_its_texture() -> None:
    scene = textured(
        f'{ABOVE}<body><freejoint/><geom type="box" size="1 1 0.5" mass="1" material="m"/></body>',
        f'{FLAT}<material name="m" texture="t"/>',
    )
    data = at(scene.mj_model)
    data.geom_xpos[0, 2] -= 0.5
    render = make_renderer(scene, size=(8, 8))
    image = np.asarray(rgb(render(data.geom_xpos, data.geom_xmat)))
    np.testing.assert_allclose(image.astype(int), RANDOM, atol=1)


@pytest.mark.parametrize(
    ("geom", "assets", "message"),
    [
        (
            'type="sphere" size="1"',
            f'{FLAT}<material name="m" texture="t"/>',
            "by its material 'm'; supported are textures of planes and boxes",
        ),
        (
            'type="plane" size="1 1 1"',
            '<texture name="t" type="2d" builtin="flat" width="12" height="12"/>'
            '<material name="m" texture="t"/>',
            "is 12 by 12 pixels; its edges must be equal, and a power of two",
        ),
        (
            'type="plane" size="1 1 1"',
            '<texture name="t" type="2d" builtin="flat" width="16" height="8"/>'
            '<material name="m" texture="t"/>',
            "is 16 by 8 pixels",
        ),
        (
            'type="plane" size="1 1 1"',
            f'{FLAT}<material name="m"><layer texture="t" role="roughness"/></material>',
            "in another role than 'rgb'",
        ),
    ],
)
def test_textures_that_cannot_be_rendered_are_rejected(
    geom: str, assets: str, message: str
) -> None:
    with pytest.raises(ValueError, match=message) as error:
        textured(f'{ABOVE}<geom {geom} material="m"/>', assets)
    assert "\n" not in str(error.value)


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="concerns XLA's fusion on CPU")
def test_the_ray_cast_is_not_repeated_for_each_texel() -> None:
    scene = load_scene("arm_cube_desk")
    data = at(scene.mj_model)
    camera = scene.mj_model.cam_pos[0].astype(np.float32)
    render = make_renderer(scene, size=(8, 8), varies={"cam_pos": (0,)})
    frames = jax.vmap(render, in_axes=(None, None, 0))
    params = {"cam_pos": jnp.tile(camera, (2, 1, 1))}
    program = jax.jit(frames).lower(data.geom_xpos, data.geom_xmat, params).compile().as_text()
    # Gathers stand for texels, and roots for the round shapes of the arm.
    kernels = program.split("\n\n")
    looking_up = [kernel for kernel in kernels if " gather(" in kernel]
    assert looking_up
    assert any(" sqrt(" in kernel for kernel in kernels)
    assert not any(" sqrt(" in kernel for kernel in looking_up)


def test_a_plain_scene_has_no_textures_in_its_program() -> None:
    scene = scene_of(f'<mujoco><worldbody>{ABOVE}<geom size="0.2"/></worldbody></mujoco>')
    data = at(scene.mj_model)
    text = (
        jax.jit(make_renderer(scene, size=(8, 8))).lower(data.geom_xpos, data.geom_xmat).as_text()
    )
    assert "gather" not in text
