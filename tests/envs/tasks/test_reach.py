from __future__ import annotations

import pathlib
from typing import ClassVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import mjx_arm
from mjx_arm.algos.frames import make_frames
from mjx_arm.envs.auto_reset import AutoResetState
from mjx_arm.envs.tasks.reach import Reach, ReachConfig, completion_reward, sparse_reward
from mjx_arm.physics import compiler_options, make_physics

XML = pathlib.Path(__file__).parents[3] / "xml"
STARTS = 2_000


@pytest.fixture(scope="module")
def env():
    return mjx_arm.make("B", task="reach", physics="native", observation="packed", size=(96, 128))


@pytest.fixture(scope="module")
def starts(env):
    def start(key):
        placement_key, start_key = jax.random.split(key)
        return env._start(start_key, env.task.sample_placement(placement_key), True)

    keys = jax.random.split(jax.random.key(3), STARTS)
    return jax.device_get(jax.jit(jax.vmap(start))(keys))


def make_scene(folder: pathlib.Path, *changes: tuple[str, str]) -> str:
    text = (XML / "arm_reach.xml").read_text().replace('"arm_cube.xml"', f'"{XML}/arm_cube.xml"')
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path = folder / "scene.xml"
    path.write_text(text)
    return str(path)


def test_every_start_is_far_enough_from_the_target(env, starts):
    site = starts.physics.poses.site_xpos[:, env.arm.grasp_site]
    distance = np.linalg.norm(starts.params["geom_pos"][:, 0] - site, axis=-1)
    assert 0.1 <= distance.min() < 0.11
    assert not jax.vmap(env.task.measure)(starts)["success"].any()


def test_the_target_is_anywhere_in_its_box(env, starts):
    box = env.scene.numbers("reach_box", 6)
    offset = (starts.params["geom_pos"][:, 0] - box[:3]) / box[3:]
    assert np.abs(offset).max() <= 1 + 1e-5
    assert (offset.min(axis=0) < -0.98).all()
    assert (offset.max(axis=0) > 0.98).all()
    home = env.scene.mj_model.key("home").qpos[env.arm.qpos]
    joints = np.rad2deg(starts.physics.qpos[:, env.arm.qpos] - home)
    assert 19.9 < np.abs(joints).max() < 20.01


def test_home_is_a_start_for_every_target_even_without_joint_noise():
    env = mjx_arm.make(
        "B",
        task="reach",
        physics="native",
        observation="state",
        joint_noise=0.0,
        placement="always",
    )
    states = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), STARTS))[1]
    assert jax.vmap(env.task.measure)(states)["distance"].min() >= 0.1


def test_environment_a_is_constant():
    env = mjx_arm.make("A", task="reach", physics="native", observation="state")
    first, second = (env.reset(jax.random.key(seed))[1] for seed in (0, 1))
    np.testing.assert_array_equal(first.physics.qpos, second.physics.qpos)
    np.testing.assert_array_equal(
        first.params["geom_pos"][0], env.scene.mj_model.geom("target").pos.astype(np.float32)
    )
    assert env.task.measure(first)["distance"] >= 0.1


def test_the_image_shows_the_target_where_the_params_say(env, starts):
    model = env.scene.mj_model
    camera, (height, width) = model.cam("front"), env.config.size
    seen = 0
    observe = jax.jit(env.observe)
    for row in range(20):
        state = jax.tree.map(lambda x, row=row: x[row], starts)
        ids = np.asarray(mjx_arm.segmentation(observe(state)))
        pixels = np.argwhere(ids == env.task.target_geom)
        local = (state.params["geom_pos"][0] - camera.pos) @ camera_axes(camera)
        focal = height / 2 / np.tan(np.deg2rad(camera.fovy[0]) / 2)
        centre = [
            height / 2 - focal * local[1] / -local[2],
            width / 2 + focal * local[0] / -local[2],
        ]
        whole = np.pi * (focal * 0.02 / -local[2]) ** 2
        # What the arm hides in part has its centre elsewhere.
        if len(pixels) > 0.85 * whole:
            seen += 1
            np.testing.assert_allclose(pixels.mean(axis=0) + 0.5, centre, atol=0.6)
    assert seen >= 12


def camera_axes(camera) -> np.ndarray:
    axes = np.zeros(9)
    mujoco.mju_quat2Mat(axes, camera.quat)
    return axes.reshape(3, 3)


def test_success_is_a_distance_of_at_most_two_centimetres(env, starts):
    state = jax.tree.map(lambda x: jnp.asarray(x[0]), starts)
    site = state.physics.poses.site_xpos[env.arm.grasp_site]
    way = jnp.asarray([2.0, -1.0, 2.0]) / 3

    def measure(distance: float, diverged: bool = False) -> dict[str, jax.Array]:
        moved = state.replace(
            params={"geom_pos": (site + distance * way)[None]},
            physics=state.physics.replace(diverged=jnp.asarray(diverged)),
        )
        return env.task.measure(moved)

    assert measure(0.01999)["success"]
    assert not measure(0.02001)["success"]
    assert not measure(0.01, diverged=True)["success"]
    np.testing.assert_allclose(measure(0.15)["distance"], 0.15, atol=1e-6)


@pytest.mark.parametrize(
    ("distance", "success", "terms"),
    [
        (0.1, False, {"reach": 0.5 * np.exp(-1), "success": 0.0}),
        (0.3, False, {"reach": 0.5 * np.exp(-3), "success": 0.0}),
        (0.015, True, {"reach": 0.0, "success": 100.0}),
    ],
)
def test_terms_of_the_reward(distance, success, terms):
    measured = {"distance": jnp.float32(distance), "success": jnp.asarray(success)}
    after = mjx_arm.Snapshot(state=None, measured=measured)
    completion = completion_reward(ReachConfig(), after, after, jnp.int32(0))
    assert completion.keys() == terms.keys()
    for name, term in terms.items():
        np.testing.assert_allclose(completion[name], term, rtol=1e-6)
    sparse = sparse_reward(ReachConfig(), after, after, jnp.int32(0))
    assert {name: float(term) for name, term in sparse.items()} == {"success": terms["success"]}


def test_success_is_worth_more_than_waiting_near_the_target():
    config = ReachConfig()
    measured = {"distance": jnp.float32(config.threshold), "success": jnp.asarray(False)}
    near = mjx_arm.Snapshot(state=None, measured=measured)
    step = sum(completion_reward(config, near, near, jnp.int32(0)).values())
    assert step / (1 - 0.99) < config.success_reward / 2


def test_both_backends_agree(env, starts):
    first = jax.tree.map(lambda x: jnp.asarray(x[0]), starts)
    physics = make_physics(
        env.scene.mj_model, "mjx", substeps=env.scene.substeps, varies=env.task.varies
    )
    states, ctrl = {}, first.ctrl
    for name, backend in {"native": env.physics, "mjx": physics}.items():
        step = jax.jit(backend.step, compiler_options=compiler_options(backend))
        state = backend.init(first.physics.qpos, ctrl, first.params)
        for turn in (0.01, 0.03, -0.02):
            state = step(state, ctrl.at[0].add(turn).at[1].add(-turn), first.params)
        states[name] = first.replace(physics=state)
    native, mjx = (states[name].physics for name in ("native", "mjx"))
    np.testing.assert_allclose(native.qpos, mjx.qpos, atol=1e-4)
    assert np.abs(native.qpos - first.physics.qpos).max() > 0.01
    for backend in (native, mjx):
        np.testing.assert_allclose(
            backend.poses.geom_xpos[env.task.target_geom], first.params["geom_pos"][0], atol=1e-6
        )
    measured = [env.task.measure(states[name])["distance"] for name in ("native", "mjx")]
    np.testing.assert_allclose(*measured, atol=1e-4)


@pytest.mark.parametrize("storage", ["states", "pixels"])
def test_the_replay_shows_the_target_of_its_own_episode(env, starts, storage):
    states = jax.tree.map(lambda x: jnp.asarray(x[:4]), starts)
    envs = AutoResetState(env=states, ended=jnp.zeros(4, bool))
    frames = make_frames(env, storage)
    obs = jax.jit(frames.observe)(envs)
    decoded = jax.jit(frames.decode)(frames.encode(envs, obs))
    # Another program may round a colour otherwise, by one of 255 levels.
    colours = [np.asarray(mjx_arm.rgb(image), int) for image in (decoded, obs)]
    assert np.abs(colours[0] - colours[1]).max() <= 1
    np.testing.assert_array_equal(mjx_arm.segmentation(decoded), mjx_arm.segmentation(obs))
    masks = np.asarray(mjx_arm.segmentation(decoded)) == env.task.target_geom
    assert masks.any(axis=(1, 2)).all()
    assert (masks[0] != masks[1]).any()


GEOM = 'contype="0" conaffinity="0" mass="0" material="green"/>'
BOX = '"0.35 0 0.2 0.1 0.2 0.15"'


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ([('name="target"', 'name="goal"')], "no geom named 'target'"),
        ([('"sphere" size="0.02"', '"box" size="0.02 0.02 0.02"')], "'target' must be a sphere"),
        (
            [('contype="0" conaffinity="0" mass', 'contype="1" mass')],
            "'target' must have no contacts",
        ),
        ([(GEOM, GEOM.replace("/>", ' group="3"/>'))], "'target' must be visible"),
        (
            [('<geom name="target"', '<body><geom name="target"'), (GEOM, f"{GEOM}</body>")],
            "'target' must be in the worldbody",
        ),
        ([('name="reach_box"', 'name="box"')], "no numeric named 'reach_box'"),
        ([(BOX, '"0.35 0 0.2 -0.1 0.2 0.15"')], "'reach_box' must have half extents of 0 or more"),
        ([(BOX, '"0.36 0 0.17 0.01 0.01 0.01"')], "'reach_box' must reach at least 0.1 m"),
        ([('pos="0.32 -0.12 0.3"', 'pos="0.36 0 0.2"')], "'target' must reach at least 0.1 m"),
    ],
)
def test_scenes_that_do_not_fit_are_rejected_by_name(tmp_path, changes, message):
    path = make_scene(tmp_path, *changes)
    with pytest.raises(ValueError, match=message):
        mjx_arm.make(task="reach", scene=path)


def test_the_arm_may_pass_through_the_target(env):
    assert env.task.target_geom not in env.collision.pairs
    assert env.task.target_geom not in env.starts.collision.pairs


def test_an_episode_cannot_start_in_success():
    with pytest.raises(ValueError, match="start_distance must be above threshold"):
        mjx_arm.make(task="reach", threshold=0.1)


def test_the_scene_has_the_arm_of_arm_cube_without_the_cube(capfd, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    scene, other = mjx_arm.load_scene("arm_reach"), mjx_arm.load_scene("arm_cube")
    assert not scene.has("body", "cube")
    model, full = scene.mj_model, other.mj_model
    assert (scene.substeps, scene.mjx_iterations) == (other.substeps, other.mjx_iterations)
    for field in ("timestep", "integrator", "cone", "impratio", "iterations", "disableflags"):
        assert getattr(model.opt, field) == getattr(full.opt, field), field
    np.testing.assert_array_equal(model.actuator_gainprm, full.actuator_gainprm)
    np.testing.assert_array_equal(model.key("home").qpos, full.key("home").qpos[: model.nq])
    np.testing.assert_array_equal(model.cam_pos, full.cam_pos)
    np.testing.assert_array_equal(model.light_dir, full.light_dir)
    np.testing.assert_array_equal(model.light_diffuse, full.light_diffuse)
    np.testing.assert_array_equal(model.body_mass[1:], full.body_mass[1 : model.nbody])
    with_table = {
        full.geom(b).name
        for a, b in zip(full.pair_geom1, full.pair_geom2, strict=True)
        if full.geom(a).name == "table" and not full.geom(b).name.startswith("cube")
    }
    assert {model.geom(b).name for b in model.pair_geom2} == with_table
    # The scene keeps all texts that the model depends on.
    (text,) = scene.files.values()
    assert text == other.xml.encode()
    assert capfd.readouterr() == ("", "")
    assert not list(tmp_path.iterdir())


class Miscounted(Reach):
    """A task that measures one thing too many, or of a wrong type, or no success."""

    changes: ClassVar[dict[str, object]] = {}

    def measure(self, state):
        """What `Reach` measures, changed."""
        measured = super().measure(state) | self.changes
        return {name: value for name, value in measured.items() if value is not None}


mjx_arm.register("miscounted", Miscounted, config=ReachConfig, scene="arm_reach")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"success": None}, "must measure 'success', got ['distance']"),
        ({"success": jnp.ones(())}, "'success' must be [] bool, got [] float32"),
        ({"max_q": jnp.ones(())}, "a run counts 'max_q' itself, give it another name"),
        ({"speed": jnp.zeros(2)}, "'speed' must be [] bool or [] float32, got [2] float32"),
    ],
)
def test_what_a_run_cannot_count_is_rejected(changes, message, monkeypatch):
    monkeypatch.setattr(Miscounted, "changes", changes)
    with pytest.raises(ValueError, match="the task 'miscounted'") as error:
        mjx_arm.make("A", task="miscounted", physics="native", observation="state")
    assert message in str(error.value)
