from __future__ import annotations

import pathlib

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import mjx_arm
from mjx_arm.algos.frames import make_frames
from mjx_arm.envs.auto_reset import AutoResetState
from mjx_arm.envs.tasks.push import PushConfig, completion_reward, sparse_reward
from mjx_arm.physics import compiler_options, make_physics

XML = pathlib.Path(__file__).parents[3] / "xml"
STARTS = 2_000


@pytest.fixture(scope="module")
def env():
    return mjx_arm.make("B", task="push", physics="native", observation="packed", size=(96, 128))


@pytest.fixture(scope="module")
def starts(env):
    def start(key):
        placement_key, start_key = jax.random.split(key)
        return env._start(start_key, env.task.sample_placement(placement_key), True)

    keys = jax.random.split(jax.random.key(3), STARTS)
    return jax.device_get(jax.jit(jax.vmap(start))(keys))


def make_scene(folder: pathlib.Path, *changes: tuple[str, str]) -> str:
    """The scene with texts replaced, in the arm's file as well."""
    for name in ("arm_cube.xml", "arm_push.xml"):
        text = (XML / name).read_text()
        for old, new in changes:
            text = text.replace(old, new)
        (folder / name).write_text(text)
    return str(folder / "arm_push.xml")


def first(starts):
    return jax.tree.map(lambda x: jnp.asarray(x[0]), starts)


def test_cube_and_mark_start_far_enough_apart(env, starts):
    cube = starts.physics.poses.geom_xpos[:, env.task.cube_geom, :2]
    mark = starts.params["geom_pos"][:, 0]
    distance = np.linalg.norm(mark[:, :2] - cube, axis=-1)
    assert 0.1 - 1e-6 <= distance.min() < 0.11
    assert np.ptp(mark[:, 2]) == 0.0
    assert not jax.vmap(env.task.measure)(starts)["success"].any()


def test_cube_and_mark_are_anywhere_in_the_rectangle(env, starts):
    rectangle = env.scene.numbers("push_rectangle", 4)
    cube = starts.physics.qpos[:, env.task.cube_qpos : env.task.cube_qpos + 2]
    for place in (cube, starts.params["geom_pos"][:, 0, :2]):
        offset = (place - rectangle[:2]) / rectangle[2:]
        assert np.abs(offset).max() <= 1 + 1e-5
        assert (offset.min(axis=0) < -0.98).all()
        assert (offset.max(axis=0) > 0.98).all()
        assert (np.abs(offset).max(axis=1) < 0.3).any()
    home = env.scene.mj_model.key("home").qpos[env.arm.qpos]
    joints = np.rad2deg(starts.physics.qpos[:, env.arm.qpos] - home)
    assert 19.9 < np.abs(joints).max() < 20.01


def test_environment_a_is_constant():
    env = mjx_arm.make("A", task="push", physics="native", observation="state")
    reset = jax.jit(env.reset)
    states = [reset(jax.random.key(seed))[1] for seed in (0, 1)]
    home = env.scene.mj_model.key("home").qpos.astype(np.float32)
    np.testing.assert_array_equal(states[0].physics.qpos, home)
    np.testing.assert_array_equal(states[0].physics.qpos, states[1].physics.qpos)
    mark = env.scene.mj_model.geom("mark").pos
    np.testing.assert_array_equal(states[0].params["geom_pos"][0], mark.astype(np.float32))


def test_the_image_shows_the_mark_where_the_params_say(env, starts):
    camera, (height, width) = env.scene.mj_model.cam("front"), env.config.size
    axes = np.zeros(9)
    mujoco.mju_quat2Mat(axes, camera.quat)
    observe, seen = jax.jit(env.observe), 0
    for row in range(20):
        state = jax.tree.map(lambda x, row=row: x[row], starts)
        ids = np.asarray(mjx_arm.segmentation(observe(state)))
        pixels = np.argwhere(ids == env.task.mark_geom)
        local = (state.params["geom_pos"][0] - camera.pos) @ axes.reshape(3, 3)
        scale = height / 2 / np.tan(np.deg2rad(camera.fovy[0]) / 2) / -local[2]
        centre = [height / 2 - scale * local[1], width / 2 + scale * local[0]]
        slope = camera.pos[2] / np.linalg.norm(camera.pos - state.params["geom_pos"][0])
        # What the arm hides in part has its centre elsewhere.
        if len(pixels) > 0.85 * np.pi * slope * (scale * 0.03) ** 2:
            seen += 1
            np.testing.assert_allclose(pixels.mean(axis=0) + 0.5, centre, atol=0.8)
    assert seen >= 12


def test_success_is_a_horizontal_distance_of_at_most_three_centimetres(env, starts):
    state = first(starts)
    poses, way = state.physics.poses, jnp.asarray([0.6, -0.8])
    mark = state.params["geom_pos"][0, :2]

    def measure(distance: float, diverged: bool = False) -> dict[str, jax.Array]:
        cube = jnp.append(mark + distance * way, 0.2)
        moved = poses.replace(geom_xpos=poses.geom_xpos.at[env.task.cube_geom].set(cube))
        physics = state.physics.replace(poses=moved, diverged=jnp.asarray(diverged))
        return env.task.measure(state.replace(physics=physics))

    assert measure(0.02999)["success"]
    assert not measure(0.03001)["success"]
    assert not measure(0.01, diverged=True)["success"]
    measured = measure(0.15)
    np.testing.assert_allclose(measured["distance"], 0.15, atol=1e-6)
    cube = np.append(mark + 0.15 * way, 0.2)
    to_cube = np.linalg.norm(cube - poses.site_xpos[env.arm.grasp_site])
    np.testing.assert_allclose(measured["to_cube"], to_cube, atol=1e-6)


@pytest.mark.parametrize(
    ("to_cube", "distance", "success", "terms"),
    [
        (0.2, 0.1, False, (0.2 * np.exp(-2), 0.5 * np.exp(-1), 0.0)),
        (0.0, 0.3, False, (0.2, 0.5 * np.exp(-3), 0.0)),
        (0.0, 0.02, True, (0.0, 0.0, 100.0)),
    ],
)
def test_terms_of_the_reward(to_cube, distance, success, terms):
    measured = {"to_cube": to_cube, "distance": distance}
    measured = {name: jnp.float32(x) for name, x in measured.items()}
    after = mjx_arm.Snapshot(state=None, measured=measured | {"success": jnp.asarray(success)})
    completion = completion_reward(PushConfig(), after, after, jnp.int32(0))
    assert list(completion) == ["reach", "push", "success"]
    np.testing.assert_allclose(list(completion.values()), terms, rtol=1e-6)
    sparse = sparse_reward(PushConfig(), after, after, jnp.int32(0))
    assert {name: float(term) for name, term in sparse.items()} == {"success": terms[2]}


def test_success_is_worth_more_than_waiting_at_the_mark():
    config = PushConfig()
    measured = {"to_cube": jnp.float32(0), "distance": jnp.float32(config.threshold)}
    near = mjx_arm.Snapshot(state=None, measured=measured | {"success": jnp.asarray(False)})
    step = sum(completion_reward(config, near, near, jnp.int32(0)).values())
    assert step / (1 - 0.99) < 0.7 * config.success_reward


def test_both_backends_agree(env, starts):
    state = first(starts)
    physics = make_physics(
        env.scene.mj_model, "mjx", substeps=env.scene.substeps, varies=env.task.varies
    )
    after, ctrl = [], state.ctrl
    for backend in (env.physics, physics):
        step = jax.jit(backend.step, compiler_options=compiler_options(backend))
        simulation = backend.init(state.physics.qpos, ctrl, state.params)
        for turn in (0.01, 0.03, -0.02):
            simulation = step(simulation, ctrl.at[0].add(turn).at[1].add(-turn), state.params)
        mark = simulation.poses.geom_xpos[env.task.mark_geom]
        np.testing.assert_allclose(mark, state.params["geom_pos"][0], atol=1e-6)
        after.append(state.replace(physics=simulation))
    np.testing.assert_allclose(after[0].physics.qpos, after[1].physics.qpos, atol=1e-4)
    assert np.abs(after[0].physics.qpos - state.physics.qpos).max() > 0.01
    for name in ("distance", "to_cube"):
        native, mjx = (env.task.measure(x)[name] for x in after)
        np.testing.assert_allclose(native, mjx, atol=1e-4)


@pytest.mark.parametrize("storage", ["states", "pixels"])
def test_the_replay_shows_the_mark_of_its_own_episode(env, starts, storage):
    states = jax.tree.map(lambda x: jnp.asarray(x[:4]), starts)
    envs = AutoResetState(env=states, ended=jnp.zeros(4, bool))
    frames = make_frames(env, storage)
    obs = jax.jit(frames.observe)(envs)
    decoded = jax.jit(frames.decode)(frames.encode(envs, obs))
    # Another program may round a colour otherwise, by one of 255 levels.
    colours = [np.asarray(mjx_arm.rgb(image), int) for image in (decoded, obs)]
    assert np.abs(colours[0] - colours[1]).max() <= 1
    np.testing.assert_array_equal(mjx_arm.segmentation(decoded), mjx_arm.segmentation(obs))
    masks = np.asarray(mjx_arm.segmentation(decoded)) == env.task.mark_geom
    assert masks.any(axis=(1, 2)).all()
    assert (masks[0] != masks[1]).any()


MARK = 'pos="0.36 -0.12 0.001"'
RECTANGLE = '"0.36 0 0.08 0.16"'
JOINT = '<freejoint name="cube"/>'
PLACE = " 0.36 0 0.025 1 0 0 0"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ([('geom name="mark"', 'geom name="goal"')], "no geom named 'mark'"),
        ([('"cylinder" size="0.03 0.001"', '"sphere" size="0.03"')], "'mark' must be a cylinder"),
        ([(MARK, f'{MARK} contype="1"')], "'mark' must have no contacts"),
        ([(MARK, f'{MARK} group="4"')], "'mark' must be visible"),
        ([(MARK, 'pos="0.36 -0.09 0.001"')], "'mark' must be at least 0.1 m"),
        ([("push_rectangle", "rectangle")], "no numeric named 'push_rectangle'"),
        ([(RECTANGLE, '"0.36 0 0.08 -0.16"')], "half extents of 0 or more"),
        ([(RECTANGLE, '"0.36 0 0.05 0.05"')], "half diagonal of at least 0.1 m"),
        ([('<geom name="cube"', '<geom pos="0 0 0.01" name="cube"')], "at the origin of its body"),
        ([('<geom name="cube"', '<geom euler="0 30 0" name="cube"')], "and not turned"),
        ([(PLACE, " 0.36 0 0.03 1 0 0 0")], "level on the ground .* got a height of 0.03 m"),
        ([(PLACE, " 0.36 0 0.025 0.9659 0.2588 0 0")], "the cube must lie level on the ground"),
        (
            [
                (
                    '<geom name="cube" type="box" size="0.025 0.025 0.025"',
                    '<geom name="cube" size=".02"',
                )
            ],
            "'cube' must be a box",
        ),
        ([(JOINT, '<freejoint name="die"/>')], "no joint named 'cube'"),
    ],
)
def test_scenes_that_do_not_fit_are_rejected_by_name(tmp_path, changes, message):
    path = make_scene(tmp_path, *changes)
    with pytest.raises(ValueError, match=message):
        mjx_arm.make(task="push", scene=path)


def test_the_arm_may_pass_through_the_mark(env):
    assert env.task.mark_geom not in env.collision.pairs
    assert env.task.mark_geom not in env.starts.collision.pairs


def test_an_episode_cannot_start_in_success():
    with pytest.raises(ValueError, match="start_distance must be above threshold"):
        mjx_arm.make(task="push", threshold=0.2)
