"""Hard shadows against rays that MuJoCo's C ray caster sends towards the light."""

from __future__ import annotations

import copy

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco_reference import (
    SHOWN_GROUPS,
    at,
    cast_rays,
    geom_poses,
    pixel_rays,
    random_primitives,
    random_qpos,
    scene_of,
)

from mjx_arm import make_renderer, rgb
from mjx_arm.scene import Scene

SIZE = (64, 64)
POSES = 2
# Points on the border of a shadow, and on surfaces that the light grazes.
MAX_MISMATCH = 0.001
# Fewer levels of diffuse light than this are lost in rounding.
MIN_DIFFUSE = 4
# Starts the rays of the reference off their own surface, m.
LIFT = 1e-4


def _blocked(scene: Scene, data: mujoco.MjData, light: int) -> np.ndarray:
    """Whether a body is between the surface at each pixel and a light, `[H, W] bool`."""
    model = scene.mj_model
    camera = model.camera("front").id
    pos, to_light = data.cam_xpos[camera], -data.light_xdir[light]
    directions = pixel_rays(data.cam_xmat[camera], model.cam_fovy[camera], SIZE)
    _, depth, _ = cast_rays(model, data, pos, directions)
    # Planes cast no shadow.
    bodies = copy.copy(model)
    bodies.geom_group[model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE] = 5
    blocked, hit = np.zeros(SIZE, bool), np.zeros(1, np.int32)
    for pixel in map(tuple, np.argwhere(np.isfinite(depth))):
        start = pos + depth[pixel] * directions[pixel] + LIFT * to_light
        mujoco.mj_ray(bodies, data, start, to_light, SHOWN_GROUPS, 1, -1, hit)
        blocked[pixel] = hit[0] >= 0
    return blocked


LAMPS = """
<light type="directional" dir="-0.6 0.5 -1" diffuse="0.4 0.2 0.6" specular="0 0 0"/>
<light type="directional" dir="0.1 0.7 -1" diffuse="0.2 0.3 0.1" specular="0 0 0"
       castshadow="false"/>"""


@pytest.fixture(scope="module")
def lamps() -> Scene:
    return random_primitives(seed=0, count=4, lights=LAMPS)


@pytest.mark.parametrize("name", ["arm", "primitives", "lamps"])
def test_shadows_fall_where_a_light_is_blocked(name: str, request: pytest.FixtureRequest) -> None:
    scene: Scene = request.getfixturevalue(name)
    model = scene.mj_model
    qposes = random_qpos(model, POSES, seed=4)
    poses = geom_poses(model, qposes)
    varies = {"light_diffuse": tuple(range(model.nlight))}
    # All lights off, and then each light alone.
    own = np.asarray(model.light_diffuse)
    alone = np.stack([np.zeros_like(own), *(np.eye(model.nlight)[..., None] * own)])
    params = {"light_diffuse": jnp.asarray(alone, jnp.float32)}

    def levels(shadows: bool) -> np.ndarray:
        render = make_renderer(scene, size=SIZE, shadows=shadows, varies=varies)
        frames = jax.vmap(jax.vmap(render, in_axes=(0, 0, None)), in_axes=(None, None, 0))
        return np.asarray(rgb(jax.jit(frames)(*poses, params))).astype(int)

    plain, shadowed = levels(shadows=False), levels(shadows=True)
    dark = plain[0]
    np.testing.assert_array_equal(shadowed[0], dark)
    states = [at(model, qpos) for qpos in qposes]
    for light in range(model.nlight):
        bright = plain[light + 1]
        if not model.light_castshadow[light]:
            np.testing.assert_array_equal(shadowed[light + 1], bright)
            continue
        diffuse = (bright - dark).max(axis=-1)
        blocked = np.stack([_blocked(scene, data, light) for data in states])
        expected = np.where((blocked | (diffuse == 0))[..., None], dark, bright)
        wrong = np.any(expected != shadowed[light + 1], axis=-1) & (diffuse >= MIN_DIFFUSE)
        assert blocked.any(axis=(1, 2)).all()
        assert wrong.mean() <= MAX_MISMATCH


LAMP = """
<mujoco>
  <visual><headlight diffuse="0 0 0"/></visual>
  <worldbody>
    <light type="directional" dir="0 0 -1" diffuse="0.8 0.8 0.8" castshadow="{castshadow}"/>
    <camera name="front" pos="0 0 3" fovy="60"/>
    <geom type="plane" size="0 0 1" rgba="1 1 1 1"/>
    <geom type="{kind}" size="0.2 0.2 0.2" pos="0 0 1" euler="{euler}"/>
    <geom type="box" size="0.05 0.05 0.05" pos="0.9 0 1.5" rgba="0 1 0 1"/>
  </worldbody>
</mujoco>"""


@pytest.mark.parametrize("kind", ["box", "sphere", "capsule", "cylinder"])
@pytest.mark.parametrize("euler", ["0 0 0", "90 0 0", "0 90 30"])
def test_light_along_the_axes_of_a_body_gives_finite_shadows(kind: str, euler: str) -> None:
    scene = scene_of(LAMP.format(castshadow="true", kind=kind, euler=euler))
    data = at(scene.mj_model)
    image = make_renderer(scene, size=SIZE, shadows=True)(data.geom_xpos, data.geom_xmat)
    plain = make_renderer(scene, size=SIZE)(data.geom_xpos, data.geom_xmat)
    # From above each body hides its own shadow, but the small box's is seen in perspective.
    darkened = np.asarray(rgb(plain))[..., 0] > np.asarray(rgb(image))[..., 0]
    assert 0 < darkened.sum() < 40


def test_a_light_may_be_without_shadows() -> None:
    scene = scene_of(LAMP.format(castshadow="false", kind="box", euler="0 0 0"))
    data = at(scene.mj_model)
    poses = (data.geom_xpos, data.geom_xmat)
    image = make_renderer(scene, shadows=True)(*poses)
    np.testing.assert_array_equal(image, make_renderer(scene)(*poses))
