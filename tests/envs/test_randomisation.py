"""Domain randomisation: ranges, keys, delays, growth, and the frames of the replay."""

from __future__ import annotations

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjx_arm
from mjx_arm.algos.frames import make_frames
from mjx_arm.config import dump_config, parse_config, train_config
from mjx_arm.envs.auto_reset import AutoReset
from mjx_arm.envs.env import Env, make_env
from mjx_arm.envs.randomisation import PRESETS, RandomisationConfig, make_randomiser
from mjx_arm.envs.scripted import make_scripted_policy
from mjx_arm.envs.tasks.lift import Lift, LiftConfig
from mjx_arm.render.geoms import geom_rgba
from mjx_arm.scene import load_scene
from mjx_arm.training.agent import evaluation_config
from mjx_arm.varies import own_params, rows

SIZE = (24, 24)
DESK = {"scene": "arm_cube_desk", "physics": "native", "size": SIZE, "observation": "packed"}
NAMES = [field.name for field in dataclasses.fields(RandomisationConfig)][2:]


def make(**options) -> Env:
    return mjx_arm.make("B", **(DESK | options))


@pytest.fixture(scope="module")
def standard() -> Env:
    return make(randomisation="standard", shadows=True)


@pytest.fixture(scope="module")
def model():
    return load_scene("arm_cube_desk").mj_model


def sample(model, count: int = 2000, growth: float = 1.0, **options) -> dict[str, np.ndarray]:
    """Params of `count` episodes, with nothing randomised but what is given."""
    config = RandomisationConfig(**options)
    randomiser = make_randomiser(config, model, ["front"])
    keys = jax.random.split(jax.random.key(0), count)
    return jax.device_get(jax.jit(jax.vmap(lambda key: randomiser.sample(key, growth)))(keys))


def test_without_randomisation_nothing_is_added() -> None:
    env = make()
    assert not env.randomiser
    assert env.varies == {}
    state = jax.eval_shape(env.reset, jax.random.key(0))[1]
    assert state.params == {}
    assert state.past == {}


def test_the_same_key_gives_the_same_episode_and_another_key_does_not(standard: Env) -> None:
    reset = jax.jit(lambda key: standard.reset(key)[1].params)
    one, again, other = (jax.device_get(reset(jax.random.key(i))) for i in (1, 1, 2))
    for name, values in one.items():
        np.testing.assert_array_equal(again[name], values)
        if name not in ("light_shadow", "image_delay", "action_delay", "mat_texture"):
            assert np.any(other[name] != values), name


@pytest.mark.parametrize("preset", ["tight", "standard"])
def test_at_growth_0_an_episode_is_the_scene_itself(model, preset: str) -> None:
    randomiser = make_randomiser(RandomisationConfig(randomisation=preset), model, ["front"])
    params = randomiser.sample(jax.random.key(0), 0.0)
    own = own_params(model, randomiser.varies)
    assert set(params) == set(own)
    # Where a geom has no colour of its own, that of its material.
    own["geom_rgba"] = geom_rgba(model)[list(randomiser.varies["geom_rgba"])]
    for name, values in params.items():
        if name == "light_dir":  # of length 1
            own[name] /= np.linalg.norm(own[name], axis=1, keepdims=True)
        if name != "image_seed":
            np.testing.assert_allclose(values, own[name], atol=2e-6, err_msg=name)


RANGED = [
    ("light_strength", (0.5, 1.5), "light_diffuse", "light_diffuse"),
    ("friction", (0.4, 2.0), "pair_friction", "pair_friction"),
    ("texture_scale", (0.5, 3.0), "mat_texrepeat", "mat_texrepeat"),
    ("link_mass", (0.7, 1.4), "body_mass", "body_mass"),
    ("servo_gain", (0.6, 1.3), "actuator_gainprm", "actuator_gainprm"),
    ("cube_size", (0.9, 1.2), "geom_size", "geom_size"),
    ("cube_mass", (0.5, 3.0), "body_mass", "body_mass"),
]


@pytest.mark.parametrize(("option", "span", "name", "field"), RANGED)
def test_factors_fill_their_range_and_no_more(model, option, span, name, field) -> None:
    params = sample(model, **{option: span})
    varies = make_randomiser(RandomisationConfig(**{option: span}), model, ["front"]).varies
    own = rows(model, field)[list(varies[field])]
    factor = (params[name] / np.where(own > 0, own, np.nan)).reshape(-1)
    factor = factor[np.isfinite(factor)]
    assert span[0] - 1e-4 <= factor.min() < span[0] + 0.05 * (span[1] - span[0])
    assert span[1] + 1e-4 >= factor.max() > span[1] - 0.05 * (span[1] - span[0])
    assert abs(factor.mean() - sum(span) / 2) < 0.03 * (span[1] - span[0])


def test_turns_and_shifts_stay_within_theirs(model) -> None:
    params = sample(model, camera_turn=8.0, camera_shift=0.04, view_change=5.0, light_angle=15.0)
    own = rows(model, "cam_quat")[0]
    angle = 2 * np.rad2deg(np.arccos(np.clip(np.abs(params["cam_quat"][:, 0] @ own), 0, 1)))
    assert 7.5 < angle.max() < 8.1
    shift = params["cam_pos"][:, 0] - rows(model, "cam_pos")[0]
    assert 0.039 < np.abs(shift).max() <= 0.0401
    change = params["cam_fovy"][:, 0] - model.cam_fovy[0]
    assert 4.9 < np.abs(change).max() <= 5.001
    to = params["light_dir"]
    np.testing.assert_allclose(np.linalg.norm(to, axis=-1), 1, atol=1e-5)
    own = rows(model, "light_dir")
    own = own / np.linalg.norm(own, axis=1, keepdims=True)
    angle = np.rad2deg(np.arccos(np.clip(np.sum(to * own, axis=-1), -1, 1)))
    assert np.all((angle.max(axis=0) > 14.5) & (angle.max(axis=0) < 15.1))


def test_shares_and_delays_have_their_frequency(model) -> None:
    params = sample(model, shadow_share=0.75, texture_swap=0.5, image_delay=2, action_delay=1)
    assert abs(params["light_shadow"].mean() - 0.75) < 0.03
    assert set(np.unique(params["image_delay"])) == {0, 1, 2}
    assert abs(params["action_delay"].mean() - 0.5) < 0.04
    names = [model.tex(i).name for i in range(model.ntex)]
    wood, carton = names.index("wood"), names.index("carton")
    kept = np.mean(params["mat_texture"][:, 0] == wood)
    # Half of the swaps could find the same texture: one in six.
    assert abs(kept - (0.5 + 0.5 / 6)) < 0.04
    assert carton not in np.unique(params["mat_texture"])


def test_colours_stay_colours_and_the_cube_stays_reddish(model) -> None:
    params = sample(model, colour_jitter=0.2, cube_red=(0.5, 1.0))
    varies = make_randomiser(RandomisationConfig(colour_jitter=0.2), model, ["front"]).varies
    rgba = params["geom_rgba"]
    assert 0 <= rgba.min() < rgba.max() <= 1
    assert (rgba[..., 3] == 1).all()
    cube = varies["geom_rgba"].index(model.geom("cube").id)
    red = rgba[:, cube, 0]
    assert (0.5 <= red.min() < 0.51, 0.99 < red.max() <= 1.0) == (True, True)


def test_masses_and_inertias_go_together(model) -> None:
    params = sample(
        model, count=50, cube_mass=(0.5, 2.0), cube_size=(0.9, 1.1), link_mass=(0.8, 1.2)
    )
    config = RandomisationConfig(cube_mass=(0.5, 2.0), cube_size=(0.9, 1.1), link_mass=(0.8, 1.2))
    varies = make_randomiser(config, model, ["front"]).varies
    own_mass = model.body_mass[list(varies["body_mass"])]
    own_inertia = model.body_inertia[list(varies["body_inertia"])]
    assert varies["body_mass"] == varies["body_inertia"]
    mass = params["body_mass"] / own_mass
    inertia = params["body_inertia"] / own_inertia
    cube = varies["body_mass"].index(model.body("cube").id)
    size = params["geom_size"][:, varies["geom_size"].index(model.geom("cube").id), 0] / 0.025
    np.testing.assert_allclose(inertia[:, cube, 0], mass[:, cube] * size**2, rtol=1e-4)
    links = [i for i in range(len(own_mass)) if i != cube]
    np.testing.assert_allclose(inertia[:, links, 1], mass[:, links], rtol=1e-4)


def _rollout(env: Env, steps: int, count: int = 3):
    """States, observations and frames of random actions, with resets: `[steps, count, ...]`."""
    auto, frames = AutoReset(env), make_frames(env, "states")

    def step(envs, key):
        action = jax.random.randint(key, (count,), 0, env.num_actions)
        obs = frames.observe(envs)
        frame = frames.encode(envs, obs)
        after, _ = jax.vmap(auto.transition)(jax.random.split(key, count), envs, action)
        return after, (envs.env, obs, frame)

    envs = jax.vmap(auto.reset)(jax.random.split(jax.random.key(5), count))[1]
    return jax.lax.scan(step, envs, jax.random.split(jax.random.key(6), steps))[1]


@pytest.mark.slow
def test_a_frame_of_the_replay_is_the_frame_that_was_seen_to_the_bit(standard: Env) -> None:
    env = dataclasses.replace(standard, config=dataclasses.replace(standard.config, max_steps=7))
    _, obs, frame = jax.jit(lambda: _rollout(env, 12))()
    decode = jax.jit(make_frames(env, "states").decode)
    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), frame)
    np.testing.assert_array_equal(decode(flat), obs.reshape(-1, *SIZE))
    # In another order and another number, as a batch is sampled.
    some = np.asarray([30, 2, 2, 17, 35])
    again = decode(jax.tree.map(lambda x: x[some], flat))
    np.testing.assert_array_equal(again, obs.reshape(-1, *SIZE)[some])
    # Everything is in it: episodes differ, and so does the noise of two steps.
    assert len(np.unique(frame["params"]["image_noise"])) > 3
    stored = sum(np.prod(x.shape[2:]) * x.dtype.itemsize for x in jax.tree.leaves(frame))
    assert stored < 800


@pytest.mark.slow
def test_delays_show_and_do_what_was_before() -> None:
    env = make(observation="state", image_delay=2, action_delay=1)
    policy = make_scripted_policy(env)

    def step(state, _):
        after, _ = env.transition(state, policy(state))
        return after, (state, env.shown_qpos(state), policy(state))

    @jax.jit
    @jax.vmap
    def run(key):
        return jax.lax.scan(step, env.reset(key)[1], length=8)[1]

    states, shown, actions = jax.device_get(run(jax.random.split(jax.random.key(3), 16)))
    late = states.params["image_delay"][:, 0, 0].astype(int)
    slow = states.params["action_delay"][:, 0, 0].astype(int)
    assert set(late) == {0, 1, 2}
    assert set(slow) == {0, 1}
    qpos, ctrl = states.physics.qpos, states.ctrl
    for i in range(16):
        for t in range(8):
            np.testing.assert_array_equal(shown[i, t], qpos[i, max(0, t - late[i])])
        np.testing.assert_array_equal((ctrl[i, 1] == ctrl[i, 0]).all(), slow[i] == 1)
        # The second command is the first action of an arm that is one step late.
        plain = make(observation="state")
        action = actions[i, 1 - slow[i]]
        state = jax.tree.map(lambda x, i=i: jnp.asarray(x[i, 1]), states)
        expected = plain._commanded(dataclasses.replace(state, past={}), jnp.asarray(action))
        np.testing.assert_array_equal(ctrl[i, 2], expected)


@pytest.mark.slow
def test_ranges_grow_with_the_age_of_an_environment() -> None:
    env = make(observation="state", growth_steps=20, camera_shift=0.1, max_steps=5)
    auto = AutoReset(env)

    def step(state, key):
        return auto.transition(key, state, 0)[0], state.env

    @jax.jit
    def run():
        state = auto.reset(jax.random.key(0))[1]
        return jax.lax.scan(step, state, jax.random.split(jax.random.key(1), 40))[1]

    states = jax.device_get(run())
    shift = np.abs(states.params["cam_pos"][:, 0] - rows(env.scene.mj_model, "cam_pos")[0])
    age = states.past["age"]
    np.testing.assert_array_equal(shift[age == 0], 0)
    assert age[-1] > 25
    starts = states.step == 0
    bound = 0.1 * np.minimum(age[starts] / 20, 1)
    assert (shift[starts].max(axis=1) <= bound + 1e-6).all()
    assert shift[-1].max() > 0.02


@pytest.mark.slow
def test_a_cube_of_any_size_lies_still_and_is_grasped() -> None:
    env = make(observation="state", cube_size=(0.9, 1.2), cube_mass=(0.5, 1.5))
    reset = jax.jit(jax.vmap(env.reset))
    _, state = reset(jax.random.split(jax.random.key(1), 8))
    policy = make_scripted_policy(env)

    @jax.jit
    @jax.vmap
    def wait(state):
        # The gripper stays open: nothing moves.
        after = jax.lax.fori_loop(
            0, 10, lambda _, s: env.transition(s, env.arm.open_action)[0], state
        )
        return env._task_of(env.varies, after.params).measure(after)["height"]

    assert np.abs(wait(state)).max() < 5e-4

    def step(state, _):
        after, transition = env.transition(state, policy(state))
        return after, transition.metrics["grasped"]

    @jax.jit
    @jax.vmap
    def grasp(state):
        return jax.lax.scan(step, state, length=150)[1].any()

    assert grasp(state).mean() >= 0.75


@pytest.mark.slow
@pytest.mark.parametrize("option", ["cube_size", "link_mass", "servo_gain", "cube_mass"])
def test_native_physics_simulates_what_the_params_say(option: str) -> None:
    """An episode is that of a model with the same numbers, by plain MuJoCo."""
    import copy

    import mujoco

    env = make(observation="state", **{option: (0.9, 1.1)})
    state = jax.jit(env.reset)(jax.random.key(2))[1]
    after = jax.jit(env.transition)(state, 3)[0]
    model = copy.copy(env.scene.mj_model)
    for field, ids in env.varies.items():
        getattr(model, field)[list(ids)] = state.params[field]
    data = mujoco.MjData(model)
    mujoco.mj_setConst(model, data)
    data.qpos[:] = state.physics.qpos
    data.ctrl[:] = after.ctrl
    for _ in range(env.scene.substeps):
        mujoco.mj_step(model, data)
    np.testing.assert_allclose(after.physics.qpos, data.qpos, atol=1e-6)


@pytest.mark.slow
def test_mjx_runs_the_whole_of_it() -> None:
    env = make(physics="mjx", observation="state", randomisation="standard")
    native = make(physics="native", observation="state", randomisation="standard")
    keys = jax.random.split(jax.random.key(0), 2)
    start = jax.jit(jax.vmap(lambda key: native.reset(key)[1]))(keys)
    mine = jax.jit(jax.vmap(lambda key: env.reset(key)[1]))(keys)
    for name, values in start.params.items():
        np.testing.assert_array_equal(mine.params[name], values)
    options = mjx_arm.physics.compiler_options(env.physics)
    step = jax.jit(jax.vmap(env.transition, in_axes=(0, None)), compiler_options=options)
    other = jax.jit(jax.vmap(native.transition, in_axes=(0, None)))
    for action in (3, 3, 5, 1):
        mine, start = step(mine, action)[0], other(start, action)[0]
    np.testing.assert_allclose(mine.physics.qpos, start.physics.qpos, atol=2e-3)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"randomisation": "wild"}, "randomisation must be one of off, tight, standard, got"),
        (
            {"camera_shift": -0.1},
            r"camera_shift must be a finite number from 0 to 0.3 or None, got",
        ),
        ({"friction": (1.5, 0.5)}, r"friction must be a least and a greatest value.*swap them"),
        ({"cube_size": (0.5, 1.0)}, r"cube_size must be two values from 0.86 to 1.5, got"),
        ({"cube_red": (0.5, 1.5)}, r"cube_red must be two values from 0 to 1, got"),
        ({"image_delay": 1.5}, "image_delay must be a whole number from 0 to 16"),
        ({"colour_jitters": 0.1}, "unknown option 'colour_jitters': did you mean 'colour_jitter'"),
        ({"light_strength": (1.0,)}, "light_strength must be a tuple of two values"),
    ],
)
def test_invalid_options_are_one_sentence(options, message: str) -> None:
    with pytest.raises(ValueError, match=message) as error:
        mjx_arm.train_config(**options)
    assert "\n" not in str(error.value)


def test_a_camera_keeps_a_field_of_view(model) -> None:
    config = RandomisationConfig(view_change=42.0)
    with pytest.raises(ValueError, match=r"view_change must be below 42 degrees.*, got 42"):
        make_randomiser(config, model, ["front"])


def test_options_are_named_without_a_group_and_survive_a_file() -> None:
    config = train_config(
        scene="arm_cube_desk", randomisation="standard", camera_shift=0.1, friction=(0.5, 2.0)
    )
    assert config.env.randomise.ranges == dataclasses.replace(
        PRESETS["standard"], camera_shift=0.1, friction=(0.5, 2.0)
    )
    assert parse_config(json.dumps(dump_config(config)), "file") == config
    # A configuration from before there was randomisation.
    old = dump_config(train_config())
    del old["env"]["randomise"], old["env"]["samples"]
    assert parse_config(json.dumps(old), "file") == train_config()


def test_an_agent_is_judged_with_the_ranges_at_their_full_width() -> None:
    config = train_config(randomisation="tight", growth_steps=1000, camera_turn=3.0)
    judged = evaluation_config(config.env)
    assert judged.randomise == dataclasses.replace(config.env.randomise, growth_steps=0)


@pytest.mark.parametrize("name", NAMES)
def test_every_option_alone_varies_something(name: str, model) -> None:
    value = getattr(PRESETS["standard"], name)
    randomiser = make_randomiser(RandomisationConfig(**{name: value}), model, ["front"])
    assert randomiser.varies
    # The scene's own values alone are no randomisation.
    assert not make_randomiser(RandomisationConfig(), model, ["front"])


@pytest.mark.slow
@pytest.mark.parametrize("scene", ["arm_cube", "arm_push", "arm_reach", "panda_cube"])
def test_the_presets_fit_every_scene(scene: str) -> None:
    task = {"arm_push": "push", "arm_reach": "reach"}.get(scene, "lift")
    config = mjx_arm.train_config(task=task, scene=scene, randomisation="standard")
    env = make_env(dataclasses.replace(config.env, physics="native", observation="state"))
    state = jax.eval_shape(lambda key: env.reset(key)[1], jax.random.key(0))
    assert set(state.params) == set(env.varies)


class Sizeless:
    """`lift` without `with_params`."""

    def __init__(self, *given):
        self._lift = Lift(*given)

    def __getattr__(self, name):
        if name == "with_params":
            raise AttributeError(name)
        return getattr(self._lift, name)


mjx_arm.register("sizeless", Sizeless, config=LiftConfig, scene="arm_cube_desk")


def test_a_task_that_does_not_know_sizes_is_rejected_where_they_vary():
    with pytest.raises(ValueError, match=r"task 'sizeless' has no method with_params.*cube_size"):
        make(task="sizeless", randomisation="standard")
    env = make(task="sizeless", randomisation="standard", cube_size=(1.0, 1.0))
    assert not env.randomiser.resizes
