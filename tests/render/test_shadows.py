"""Hard shadows against rays that MuJoCo's C ray caster sends towards the light."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable

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
    random_qpos,
    scene_of,
)

from mjx_arm import Appearance, default_appearance, make_renderer, rgb
from mjx_arm.scene import Scene

SIZE = (64, 64)
POSES = 2
# Points on the border of a shadow, and on surfaces that the light grazes.
MAX_MISMATCH = 0.001
# Fewer levels of diffuse light than this are lost in rounding.
MIN_DIFFUSE = 4
# Starts the rays of the reference off their own surface, m.
LIFT = 1e-4


def _blocked(scene: Scene, data: mujoco.MjData) -> np.ndarray:
    """Whether a body is between the surface at each pixel and the light, `[H, W] bool`."""
    model = scene.mj_model
    camera = model.camera("front").id
    pos, to_light = data.cam_xpos[camera], -data.light_xdir[0]
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


@pytest.mark.parametrize("name", ["arm", "primitives"])
def test_shadows_fall_where_the_light_is_blocked(name: str, request: pytest.FixtureRequest) -> None:
    scene: Scene = request.getfixturevalue(name)
    qposes = random_qpos(scene.mj_model, POSES, seed=4)
    poses = geom_poses(scene.mj_model, qposes)
    own = default_appearance(scene)
    unlit = dataclasses.replace(own, light_diffuse=jnp.zeros(3, jnp.float32))

    def drawing(shadows: bool) -> Callable[[Appearance], np.ndarray]:
        render = jax.vmap(make_renderer(scene, size=SIZE, shadows=shadows), in_axes=(0, 0, None))
        return lambda look: np.asarray(rgb(render(*poses, look))).astype(int)

    plain = drawing(shadows=False)
    bright, dark, shadowed = plain(own), plain(unlit), drawing(shadows=True)(own)
    diffuse = (bright - dark).max(axis=-1)
    blocked = np.stack([_blocked(scene, at(scene.mj_model, qpos)) for qpos in qposes])
    expected = np.where((blocked | (diffuse == 0))[..., None], dark, bright)
    wrong = np.any(expected != shadowed, axis=-1) & (diffuse >= MIN_DIFFUSE)
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
