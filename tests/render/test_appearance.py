"""Camera, light and colours as arguments."""

from __future__ import annotations

import copy
import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mujoco_reference import at, geom_poses, random_qpos, scene_of

from mjx_arm import Appearance, default_appearance, make_renderer, rgb
from mjx_arm.scene import Scene

# Cached and fresh backgrounds are compiled apart, and may round apart: levels of 255.
MAX_LEVELS = 1


def _levels(packed: jax.Array) -> np.ndarray:
    return np.asarray(rgb(packed)).astype(int)


@pytest.mark.parametrize("shadows", [False, True])
def test_the_models_own_appearance_changes_nothing(arm: Scene, shadows: bool) -> None:
    data = at(arm.mj_model, random_qpos(arm.mj_model, 1, seed=10)[0])
    render = make_renderer(arm, shadows=shadows)
    own = render(data.geom_xpos, data.geom_xmat, default_appearance(arm))
    cached = render(data.geom_xpos, data.geom_xmat)
    assert np.mean(np.abs(_levels(own) - _levels(cached)) > MAX_LEVELS) < 0.001


def test_an_appearance_does_what_the_same_change_of_the_model_does(primitives: Scene) -> None:
    changed = copy.copy(primitives.mj_model)
    rng = np.random.default_rng(11)
    changed.cam_pos[0] += rng.uniform(-0.1, 0.1, 3)
    changed.cam_fovy[0] = 61.0
    changed.light_dir[0] = [-0.4, 0.2, -0.89]
    changed.light_diffuse[0] = [0.3, 0.4, 0.5]
    changed.vis.headlight.ambient[:] = [0.4, 0.3, 0.2]
    changed.geom_matid[:] = -1
    changed.geom_rgba[:, :3] = rng.uniform(0.1, 0.9, (changed.ngeom, 3))
    other = Scene(name="changed", mj_model=changed)
    data = at(changed, random_qpos(changed, 1, seed=12)[0])
    poses = (data.geom_xpos, data.geom_xmat)

    by_model = make_renderer(other, shadows=True)(*poses)
    look = default_appearance(other)
    by_argument = make_renderer(primitives, shadows=True)(*poses, look)
    plain = make_renderer(primitives, shadows=True)(*poses)
    assert np.mean(np.abs(_levels(by_model) - _levels(by_argument)) > MAX_LEVELS) < 0.001
    assert np.mean(np.abs(_levels(by_model) - _levels(plain)) > MAX_LEVELS) > 0.9


def test_vmapped_appearances_each_draw_their_own(arm: Scene) -> None:
    xpos, xmat = geom_poses(arm.mj_model, random_qpos(arm.mj_model, 3, seed=13))
    own = default_appearance(arm)
    render = make_renderer(arm, size=(16, 16))

    def look(ambient: jax.Array) -> Appearance:
        return dataclasses.replace(own, ambient=ambient)

    ambients = jnp.asarray([[0.1, 0.1, 0.1], [0.3, 0.2, 0.1], [0.0, 0.0, 0.5]], jnp.float32)
    batch = jax.jit(jax.vmap(lambda p, m, a: render(p, m, look(a))))(xpos, xmat, ambients)
    for i in range(3):
        one = render(xpos[i], xmat[i], look(ambients[i]))
        assert np.mean(np.abs(_levels(batch[i]) - _levels(one)) > MAX_LEVELS) < 0.01


def test_lambert_by_hand() -> None:
    """A white table under light of 60 degrees: colour * (ambient + diffuse / 2)."""
    scene = scene_of("""
<mujoco>
  <visual><headlight ambient="0.1 0.2 0.3" diffuse="0 0 0"/></visual>
  <worldbody>
    <light type="directional" dir="0.8660254 0 -0.5" diffuse="0.6 0.4 0.2" ambient="0.1 0 0"/>
    <camera name="front" pos="0 0 1"/>
    <geom type="plane" size="0 0 1" rgba="1 0.5 0.25 1"/>
  </worldbody>
</mujoco>""")
    data = at(scene.mj_model)
    image = _levels(make_renderer(scene, size=(2, 2))(data.geom_xpos, data.geom_xmat))
    expected = 255 * np.asarray([1, 0.5, 0.25]) * np.asarray([0.5, 0.4, 0.4])
    np.testing.assert_allclose(image, np.broadcast_to(expected, image.shape), atol=1)


def test_headlight_and_no_light_at_all() -> None:
    xml = """
<mujoco>
  <visual><headlight active="{active}" ambient="0.1 0.1 0.1" diffuse="0.5 0.5 0.5"/></visual>
  <worldbody>
    <camera name="front" pos="0 0 1"/>
    <geom type="plane" size="0 0 1" rgba="1 1 1 1"/>
  </worldbody>
</mujoco>"""
    for active, level in ((1, 0.6), (0, 0.3)):
        scene = scene_of(xml.format(active=active))
        data = at(scene.mj_model)
        image = _levels(make_renderer(scene, size=(1, 1))(data.geom_xpos, data.geom_xmat))
        np.testing.assert_allclose(image, 255 * level, atol=1)


CAMERA = '<camera name="front" pos="0 0 1" {}/>'
SUN = '<light name="sun" type="directional" {}/>'


@pytest.mark.parametrize(
    ("world", "message"),
    [
        (CAMERA.format("") + SUN.format("") + '<light name="lamp"/>', "'sun', 'lamp'"),
        (CAMERA.format("") + '<light name="lamp" type="spot"/>', "'lamp' is not directional"),
        (
            CAMERA.format("") + f"<body><freejoint/><geom size='1'/>{SUN.format('')}</body>",
            "'sun' moves",
        ),
        (CAMERA.format('mode="targetbody" target="b"') + "<body name='b'/>", "'front' moves"),
        (f"<body><freejoint/><geom size='1'/>{CAMERA.format('')}</body>", "'front' moves"),
        (CAMERA.format('projection="orthographic"'), "'front' is orthographic"),
        (CAMERA.format('sensorsize="1 1" resolution="9 9" focal="1 1"'), "sensor size"),
        ('<camera name="side"/>', r"unknown camera 'front': the scene has \['side'\]"),
    ],
)
def test_what_cannot_be_drawn_is_refused_by_name(world: str, message: str) -> None:
    scene = scene_of(f"<mujoco><worldbody>{world}</worldbody></mujoco>")
    with pytest.raises(ValueError, match=message) as error:
        default_appearance(scene)
    assert "\n" not in str(error.value)


def test_a_light_that_is_switched_off_is_no_light() -> None:
    world = CAMERA.format("") + SUN.format('active="false"')
    scene = scene_of(f"<mujoco><worldbody>{world}</worldbody></mujoco>")
    assert np.all(np.asarray(default_appearance(scene).light_diffuse) == 0)
