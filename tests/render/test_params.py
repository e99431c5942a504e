"""What varies by episode: the image is that of a model with the same fields edited."""

from __future__ import annotations

import copy
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco_reference import (
    at,
    cast_camera,
    geom_poses,
    random_primitives,
    random_qpos,
    scene_of,
    shaded,
    wrist_scene,
)

from mjx_arm import make_renderer, rgb, segmentation
from mjx_arm.kinematics import make_camera_pose, make_kinematics
from mjx_arm.render import renderer
from mjx_arm.scene import Scene
from mjx_arm.varies import own_params, rows

EPISODES = 20
SIZE = (48, 64)
# Pixels whose ray passes an edge within float32 rounding.
MAX_MISMATCH = 0.0003
MAX_DEPTH_P99 = 1e-4
# The geom's own colour is rounded, then the lit one; silhouettes bend away faster. Of 255.
MAX_LEVELS = 2.0

LAMP = '<light type="directional" dir="-0.6 0.5 -1" ambient="0.05 0.02 0.1" specular="0 0 0"/>'


@pytest.fixture(scope="module")
def lamps() -> Scene:
    return random_primitives(seed=0, count=4, lights=LAMP)


def _varies(model: mujoco.MjModel) -> dict[str, tuple[int, ...]]:
    step, pole, floor = (model.geom(name).id for name in ("step", "pole", "floor"))
    free = tuple(range(model.ngeom - 4, model.ngeom))
    return {
        "geom_rgba": (model.ngeom - 1, floor, step, model.geom("clear").id),
        "geom_size": (step, *free),
        "geom_pos": (pole, free[0]),
        "geom_quat": (pole,),
        "light_dir": (1, 0),
        "light_diffuse": (0, 1),
        "light_ambient": (1,),
        "headlight_ambient": (0,),
        "headlight_diffuse": (0,),
        "cam_pos": (0,),
        "cam_quat": (0,),
        "cam_fovy": (0,),
        "geom_friction": (step,),
    }


def _sample(model: mujoco.MjModel, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Values near those of the model, and now and then an invisible geom."""
    scale = {"cam_fovy": 10.0, "light_dir": 0.3, "geom_size": 0.02}
    params = {}
    for field, ids in _varies(model).items():
        own = rows(model, field)[list(ids)]
        noise = scale.get(field, 0.1) * rng.uniform(-1, 1, own.shape)
        params[field] = (own + noise).astype(np.float32)
    for quat in ("cam_quat", "geom_quat"):
        params[quat] /= np.linalg.norm(params[quat], axis=-1, keepdims=True)
    params["geom_size"] = np.maximum(params["geom_size"], 0.015)
    params["geom_rgba"] = rng.uniform(0.1, 0.9, params["geom_rgba"].shape).astype(np.float32)
    # The large box around the scene would hide all of it. The ray caster wants alpha of the
    # material at zero as well, where a geom has one.
    params["geom_rgba"][3, 3] = 0
    params["geom_rgba"][rng.choice([0, 1, 3]), 3] = 0
    return {name: np.abs(x) if "ambient" in name else x for name, x in params.items()}


def _edited(model: mujoco.MjModel, params: dict[str, np.ndarray]) -> mujoco.MjModel:
    edited = copy.copy(model)
    for field, ids in _varies(model).items():
        if field.startswith("headlight_"):
            getattr(edited.vis.headlight, field.removeprefix("headlight_"))[:] = params[field][0]
        else:
            getattr(edited, field)[list(ids)] = params[field]
    # What the compiler derived: bounds by which the ray caster skips geoms, and marks of equal
    # frames, by which MuJoCo ignores the pose of a geom.
    edited.geom_sameframe[:] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE
    edited.geom_rbound[edited.geom_rbound > 0] = 2.0
    return edited


def test_random_params_do_what_edits_of_the_model_do(lamps: Scene) -> None:
    model, rng = lamps.mj_model, np.random.default_rng(0)
    varies = _varies(model)
    qposes = random_qpos(model, EPISODES, seed=20)
    episodes = [_sample(model, rng) for _ in range(EPISODES)]
    render = make_renderer(model, size=SIZE, depth=True, varies=varies)
    kinematics = make_kinematics(model, varies)

    def frame(qpos: jax.Array, params: Any) -> Any:
        poses = kinematics(qpos, params)
        return render(poses.geom_xpos, poses.geom_xmat, params)

    params = jax.tree.map(lambda *values: jnp.stack(values), *episodes)
    packed, depth = jax.jit(jax.vmap(frame))(jnp.asarray(qposes, jnp.float32), params)
    geom, levels = np.asarray(segmentation(packed)), np.asarray(rgb(packed), float)

    truth, colours = [], []
    for qpos, values in zip(qposes, episodes, strict=True):
        edited = _edited(model, values)
        data = at(edited, qpos)
        truth.append(cast_camera(edited, data, "front", SIZE))
        colours.append(shaded(edited, data, "front", truth[-1][0], truth[-1][2]))
    true_geom, true_depth, _ = (np.stack(part) for part in zip(*truth, strict=True))
    assert np.mean(geom != true_geom) <= MAX_MISMATCH
    agree = (geom == true_geom) & (geom >= 0)
    error = np.abs(np.asarray(depth)[agree] - true_depth[agree])
    assert np.percentile(error, 99) < MAX_DEPTH_P99
    assert np.percentile(np.abs(levels - np.stack(colours))[agree], 99.9) < MAX_LEVELS


def test_the_models_own_params_change_nothing(lamps: Scene) -> None:
    model = lamps.mj_model
    data = at(model, random_qpos(model, 1, seed=10)[0])
    varies = _varies(model)
    plain = make_renderer(lamps, size=SIZE, shadows=True)(data.geom_xpos, data.geom_xmat)
    render = make_renderer(lamps, size=SIZE, shadows=True, varies=varies)
    varied = render(data.geom_xpos, data.geom_xmat, own_params(model, varies))
    # Cached and fresh backgrounds are compiled apart, and may round apart.
    levels = [np.asarray(rgb(image)).astype(int) for image in (plain, varied)]
    assert np.mean(np.abs(levels[0] - levels[1]) > 1) < 0.001


def test_the_default_grey_means_the_materials_colour() -> None:
    model = scene_of("""
<mujoco>
  <visual><headlight ambient="1 1 1" diffuse="0 0 0"/></visual>
  <asset><material name="green" rgba="0 1 0 1"/></asset>
  <worldbody>
    <camera name="front" pos="0 0 1"/>
    <geom type="plane" size="0 0 1" rgba="1 0 0 1" material="green"/>
  </worldbody>
</mujoco>""").mj_model
    data = at(model)
    render = make_renderer(model, size=(1, 1), varies={"geom_rgba": (0,)})
    for colour, level in (([0.5, 0.5, 0.5, 1], [0, 255, 0]), ([0.5, 0.5, 0.5, 0.9], [128] * 3)):
        params = {"geom_rgba": jnp.asarray([colour], jnp.float32)}
        image = rgb(render(data.geom_xpos, data.geom_xmat, params))
        assert np.asarray(image)[0, 0].tolist() == level


@pytest.mark.parametrize(
    ("varies", "once"),
    [
        ({}, True),
        ({"light_diffuse": (0,), "light_ambient": (0,), "headlight_ambient": (0,)}, True),
        ({"geom_rgba": (0,), "geom_size": (2,), "geom_pos": (2,)}, True),
        ({"body_mass": (1,)}, True),
        ({"light_dir": (0,)}, False),
        ({"cam_fovy": (0,)}, False),
        ({"cam_quat": (0,)}, False),
        ({"body_pos": (0,), "body_quat": (1,)}, True),
    ],
)
def test_what_is_cast_in_every_frame(
    primitives: Scene,
    varies: dict[str, tuple[int, ...]],
    once: bool,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    model = primitives.mj_model
    render = make_renderer(model, size=(8, 8), varies=varies)
    seen: list[int] = []

    def cast(groups: Any, *args: Any) -> Any:
        seen.extend(int(geom) for group in groups for geom in group.ids)
        return args[-1]

    monkeypatch.setattr(renderer, "cast", cast)
    data = at(model)
    render(data.geom_xpos, data.geom_xmat, own_params(model, varies))
    visible = {i for i in range(model.ngeom) if model.geom_group[i] < 3 and model.geom_rgba[i, 3]}
    free = {i for i in visible if model.geom_bodyid[i] > 0}
    varying = {row for name, ids in varies.items() if name.startswith("geom_") for row in ids}
    assert set(seen) == (free | varying if once else visible)
    assert len(seen) == len(set(seen))


def test_fields_that_do_not_concern_the_image_cost_nothing(arm: Scene) -> None:
    data = at(arm.mj_model)
    varies = {"body_mass": (1, 2), "geom_friction": (0,)}
    poses = (data.geom_xpos, data.geom_xmat)

    def operations(render: Any, *args: Any) -> str:
        (call,) = jax.make_jaxpr(render)(*args).eqns
        return [str(equation.primitive) for equation in call.params["jaxpr"].eqns]

    plain = operations(make_renderer(arm, size=(8, 8)), *poses)
    render = make_renderer(arm, size=(8, 8), varies=varies)
    assert operations(render, *poses, own_params(arm.mj_model, varies)) == plain


def test_a_wrist_camera_sees_what_mujocos_sees() -> None:
    scene = wrist_scene()
    model = scene.mj_model
    qposes = random_qpos(model, EPISODES, seed=21)
    varies = {"cam_pos": (model.camera("wrist").id,), "cam_fovy": (model.camera("wrist").id,)}
    camera_pose = make_camera_pose(model, "wrist", varies)
    render = make_renderer(scene, camera="wrist", size=SIZE, depth=True, varies=varies)
    rng = np.random.default_rng(0)
    params = {
        "cam_pos": (model.cam_pos[1] + rng.uniform(-0.01, 0.01, (EPISODES, 1, 3))),
        "cam_fovy": rng.uniform(50, 90, (EPISODES, 1)),
    }
    params = {name: x.astype(np.float32) for name, x in params.items()}

    def frame(qpos: jax.Array, xpos: jax.Array, xmat: jax.Array, params: Any) -> Any:
        return render(xpos, xmat, params, camera_pose(qpos, params))

    frames = jax.jit(jax.vmap(frame))
    packed, depth = frames(jnp.asarray(qposes, jnp.float32), *geom_poses(model, qposes), params)
    geom = np.asarray(segmentation(packed))
    truth = []
    for i, qpos in enumerate(qposes):
        edited = copy.copy(model)
        edited.cam_pos[1], edited.cam_fovy[1] = params["cam_pos"][i, 0], params["cam_fovy"][i, 0]
        truth.append(cast_camera(edited, at(edited, qpos), "wrist", SIZE))
    true_geom, true_depth, _ = (np.stack(part) for part in zip(*truth, strict=True))
    assert np.mean(geom != true_geom) <= MAX_MISMATCH
    agree = (geom == true_geom) & (geom >= 0)
    error = np.abs(np.asarray(depth)[agree] / true_depth[agree] - 1)
    assert np.percentile(error, 99) < MAX_DEPTH_P99
    # The fingers, the cube in some frames, and the table.
    assert len(np.unique(true_geom)) > 4


def test_a_pose_replaces_that_of_a_fixed_camera(arm: Scene) -> None:
    data = at(arm.mj_model)
    poses = (data.geom_xpos, data.geom_xmat)
    render = make_renderer(arm, size=(16, 16))
    own = (data.cam_xpos[0], data.cam_xmat[0])
    assert np.mean(np.asarray(render(*poses, {}, own)) != render(*poses)) < 0.01


def test_a_moving_camera_demands_its_pose() -> None:
    model = wrist_scene().mj_model
    data = at(model)
    render = make_renderer(model, camera="wrist", size=(8, 8))
    with pytest.raises(ValueError, match=r"camera 'wrist' is on a moving body.*camera_pose"):
        render(data.geom_xpos, data.geom_xmat)
    with pytest.raises(ValueError, match=r"shapes \[2, 3\] and \[2, 9\].*jax.vmap"):
        render(data.geom_xpos, data.geom_xmat, {}, (data.cam_xpos, data.cam_xmat))


@pytest.mark.parametrize(
    ("varies", "message"),
    [
        ({"geom_colour": (0,)}, "'geom_colour' is not a float array"),
        ({"geom_rgba": (99,)}, "has the row 99"),
        ({"mat_rgba": (0,)}, "'mat_rgba' changes the image, but the renderer cannot vary it"),
        ({"cam_sensorsize": (0,)}, "'cam_sensorsize' changes the image"),
    ],
)
def test_what_cannot_vary_is_rejected_by_name(
    primitives: Scene, varies: dict[str, tuple[int, ...]], message: str
) -> None:
    with pytest.raises(ValueError, match=message) as error:
        make_renderer(primitives, varies=varies)
    assert "\n" not in str(error.value)


def test_params_that_do_not_fit_are_rejected_by_name(primitives: Scene) -> None:
    data = at(primitives.mj_model)
    render = make_renderer(primitives, size=(8, 8), varies={"light_dir": (0,)})
    with pytest.raises(ValueError, match="params lacks 'light_dir'"):
        render(data.geom_xpos, data.geom_xmat)
    with pytest.raises(ValueError, match=r"params\['light_dir'\] has the shape \[3\]"):
        render(data.geom_xpos, data.geom_xmat, {"light_dir": jnp.zeros(3)})


def test_a_headlight_that_is_switched_off_cannot_vary(primitives: Scene) -> None:
    dark = copy.copy(primitives.mj_model)
    dark.vis.headlight.active = 0
    with pytest.raises(ValueError, match=r"'headlight_diffuse' varies, but .* not active"):
        make_renderer(dark, varies={"headlight_diffuse": (0,)})
