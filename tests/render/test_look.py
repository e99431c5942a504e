"""Camera, lights and colours of the model."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from mujoco_reference import at, scene_of

from mjx_arm import make_renderer, rgb


def _levels(packed: jax.Array) -> np.ndarray:
    return np.asarray(rgb(packed)).astype(int)


def _image(xml: str, size: tuple[int, int] = (2, 2)) -> np.ndarray:
    scene = scene_of(xml)
    data = at(scene.mj_model)
    return _levels(make_renderer(scene, size=size)(data.geom_xpos, data.geom_xmat))


TABLE = """
<mujoco>
  <visual><headlight {headlight}/></visual>
  <worldbody>
    {lights}
    <camera name="front" pos="0 0 1"/>
    <geom type="plane" size="0 0 1" rgba="1 0.5 0.25 1"/>
  </worldbody>
</mujoco>"""


def test_lambert_by_hand() -> None:
    """A white table under light of 60 degrees: colour * (ambient + diffuse / 2)."""
    light = (
        '<light type="directional" dir="0.8660254 0 -0.5" diffuse="0.6 0.4 0.2" ambient="0.1 0 0"/>'
    )
    image = _image(
        TABLE.format(headlight='ambient="0.1 0.2 0.3" diffuse="0 0 0"', lights=light),
    )
    expected = 255 * np.asarray([1, 0.5, 0.25]) * np.asarray([0.5, 0.4, 0.4])
    np.testing.assert_allclose(image, np.broadcast_to(expected, image.shape), atol=1)


def test_lights_add_up_and_saturate() -> None:
    lights = """
    <light type="directional" dir="0.8660254 0 -0.5" diffuse="0.2 0.4 2" ambient="0.1 0 0"/>
    <light type="directional" dir="0 0 -2" diffuse="0.3 0.1 0.5" ambient="0 0.1 0"/>
    <light type="directional" dir="0 0 1" diffuse="1 1 1" ambient="0 0 0"/>
    <light type="directional" dir="0 0 -1" diffuse="1 1 1" ambient="1 1 1" active="false"/>"""
    image = _image(
        TABLE.format(headlight='ambient="0.05 0.05 0.05" diffuse="0.1 0.2 3.0"', lights=lights),
    )
    total = np.asarray([0.1 + 0.1 + 0.3 + 0.05 + 0.1, 0.2 + 0.1 + 0.1 + 0.05 + 0.2, 5.0])
    expected = np.minimum(255 * np.asarray([1, 0.5, 0.25]) * total, 255)
    np.testing.assert_allclose(image, np.broadcast_to(expected, image.shape), atol=1)


@pytest.mark.parametrize(("active", "level"), [(1, 0.6), (0, 0.3)])
def test_headlight_and_no_light_at_all(active: int, level: float) -> None:
    headlight = f'active="{active}" ambient="0.1 0.1 0.1" diffuse="0.5 0.5 0.5"'
    image = _image(TABLE.format(headlight=headlight, lights=""), size=(1, 1))
    expected = 255 * np.asarray([1, 0.5, 0.25]) * level
    np.testing.assert_allclose(image, np.broadcast_to(expected, image.shape), atol=1)


CAMERA = '<camera name="front" pos="0 0 1" {}/>'
SUN = '<light name="sun" type="directional" {}/>'


@pytest.mark.parametrize(
    ("world", "message"),
    [
        (CAMERA.format("") + SUN.format("") + '<light name="lamp"/>', "'lamp' is not directional"),
        (CAMERA.format("") + '<light name="lamp" type="point"/>', "'lamp' is not directional"),
        (
            CAMERA.format("") + f"<body><freejoint/><geom size='1'/>{SUN.format('')}</body>",
            "'sun' moves",
        ),
        (
            CAMERA.format('mode="targetbody" target="b"') + "<body name='b'/>",
            "'front' has the mode 'targetbody'",
        ),
        (
            "<body><freejoint/><geom size='1'/>" + CAMERA.format('mode="trackcom"') + "</body>",
            "'front' has the mode 'trackcom'",
        ),
        (CAMERA.format('projection="orthographic"'), "'front' is orthographic"),
        (CAMERA.format('sensorsize="1 1" resolution="9 9" focal="1 1"'), "sensor size"),
        ('<camera name="side"/>', r"unknown camera 'front': the scene has \['side'\]"),
    ],
)
def test_what_cannot_be_rendered_is_rejected_by_name(world: str, message: str) -> None:
    scene = scene_of(f"<mujoco><worldbody>{world}</worldbody></mujoco>")
    with pytest.raises(ValueError, match=message) as error:
        make_renderer(scene)
    assert "\n" not in str(error.value)
