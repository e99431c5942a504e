from __future__ import annotations

import dataclasses
import functools
import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjx_arm


@pytest.fixture(scope="module")
def env():
    return mjx_arm.make("A", physics="native")


@functools.cache
def reset_once(env):
    return jax.jit(env.reset)(jax.random.key(0))


def structure(tree):
    return jax.tree.map(lambda x: (x.shape, str(x.dtype), x.weak_type), tree)


def test_step_returns_what_reset_returns(env):
    reset = jax.eval_shape(env.reset, jax.random.key(0))
    step = jax.eval_shape(env.step, jax.random.key(0), reset[1], jnp.int32(0))
    assert structure(reset) == structure(step[:2])
    reward, terminated, truncated = step[2:5]
    assert (reward.shape, reward.dtype) == ((), jnp.float32)
    assert (terminated.shape, terminated.dtype) == ((), jnp.bool_)
    assert (truncated.shape, truncated.dtype) == ((), jnp.bool_)


def test_step_compiles_once(env):
    step = jax.jit(env.step)
    _, state = jax.jit(env.reset)(jax.random.key(0))
    for action in range(3):
        _, state, *_ = step(jax.random.key(0), state, action)
    assert step._cache_size() == 1


@pytest.mark.parametrize(
    ("observation", "shape", "dtype"),
    [
        ("rgb", (48, 80, 3), jnp.uint8),
        ("segmentation", (48, 80), jnp.int32),
        ("packed", (48, 80), jnp.uint32),
        ("state", (21,), jnp.float32),
    ],
)
def test_observations_have_the_promised_shape(observation, shape, dtype):
    env = mjx_arm.make("A", physics="native", observation=observation, size=(48, 80))
    obs, _ = jax.jit(env.reset)(jax.random.key(0))
    assert (obs.shape, obs.dtype) == (shape, dtype)


def test_rgbd_is_colour_and_depth():
    env = mjx_arm.make("A", physics="native", observation="rgbd", size=(32, 32))
    obs, _ = jax.jit(env.reset)(jax.random.key(0))
    assert (obs["rgb"].shape, obs["rgb"].dtype) == ((32, 32, 3), jnp.uint8)
    assert (obs["depth"].shape, obs["depth"].dtype) == ((32, 32), jnp.float32)
    seen = np.asarray(obs["depth"])[np.isfinite(obs["depth"])]
    assert 0.3 < seen.min() < seen.max() < 20.0


def test_the_image_shows_the_cube(env):
    packed = mjx_arm.make("A", physics="native", observation="segmentation")
    obs, _ = jax.jit(packed.reset)(jax.random.key(0))
    assert (np.asarray(obs) == env.task.cube_geom).sum() > 20


def test_an_action_changes_what_is_seen(env):
    obs, state = jax.jit(env.reset)(jax.random.key(0))
    step = jax.jit(env.step)
    for _ in range(5):
        after, state, *_ = step(jax.random.key(0), state, 3)
    assert (np.asarray(after) != np.asarray(obs)).any()


def test_environment_a_is_constant(env):
    reset = jax.jit(jax.vmap(lambda key: env.reset(key)[1].physics.qpos))
    qpos = np.asarray(reset(jax.random.split(jax.random.key(0), 3)))
    np.testing.assert_array_equal(qpos, np.broadcast_to(env.arm.home_qpos, qpos.shape))


def test_an_episode_is_truncated_after_max_steps_and_not_before():
    env = mjx_arm.make("A", physics="native", observation="state", max_steps=3)
    _, state = jax.jit(env.reset)(jax.random.key(0))
    step, flags = jax.jit(env.step), []
    for _ in range(4):
        _, state, _, terminated, truncated, _ = step(jax.random.key(0), state, env.arm.open_action)
        flags.append((bool(terminated), bool(truncated)))
    assert flags == [(False, False), (False, False), (False, True), (False, True)]


def test_by_default_an_episode_has_1000_iterations():
    assert mjx_arm.EnvConfig().max_steps == 1000


def test_lifting_terminates_and_pays_once_lifted():
    env = mjx_arm.make("A", physics="native", observation="state", start="in_grasp", lift=0.2)
    _, state = jax.jit(env.reset)(jax.random.key(0))
    step = jax.jit(env.step)
    for _ in range(40):
        _, state, reward, terminated, truncated, info = step(jax.random.key(0), state, 2)
        if terminated:
            break
    assert terminated
    assert not truncated
    assert info["grasped"]
    assert info["height"] >= 0.2
    assert reward == 100.0


def test_start_in_grasp_holds_the_cube_and_open_drops_it():
    env = mjx_arm.make("B", physics="native", observation="state", start="in_grasp")
    keys = jax.random.split(jax.random.key(1), 16)
    _, state = jax.jit(jax.vmap(env.reset))(keys)
    step = jax.jit(jax.vmap(env.transition))
    for _ in range(30):
        state, transition = step(state, jnp.full(16, env.arm.close_action))
    assert transition.metrics["grasped"].all()
    height = np.asarray(transition.metrics["height"])
    for _ in range(10):
        state, transition = step(state, jnp.full(16, env.arm.open_action))
    assert not transition.metrics["grasped"].any()
    assert (np.asarray(transition.metrics["height"]) < height - 0.02).all()


def test_two_keys_give_two_starts_in_b():
    env = mjx_arm.make("B", physics="native", observation="state")
    reset = jax.jit(env.reset)
    one, other = reset(jax.random.key(0))[1], reset(jax.random.key(1))[1]
    assert (one.physics.qpos[env.arm.qpos] != other.physics.qpos[env.arm.qpos]).all()
    assert (one.placement != other.placement).all()


def test_a_diverged_simulation_ends_its_own_episode_only():
    env = mjx_arm.make("A", physics="native", observation="state")
    _, state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 3))
    sane = jax.jit(jax.vmap(env.transition))(state, jnp.full(3, 3))
    words = state.physics.integration.at[1, 2 * (1 + env.scene.mj_model.nq) + 1].set(
        jnp.uint32(0x7FF80000)
    )
    poisoned = state.replace(physics=state.physics.replace(integration=words))
    after, transition = jax.jit(jax.vmap(env.transition))(poisoned, jnp.full(3, 3))
    np.testing.assert_array_equal(transition.info["diverged"], [False, True, False])
    np.testing.assert_array_equal(transition.truncated, [False, True, False])
    assert not transition.terminated.any()
    for tree in (after.physics.qpos, transition.reward):
        assert np.isfinite(tree).all()
    np.testing.assert_array_equal(after.physics.qpos[::2], sane[0].physics.qpos[::2])


@pytest.mark.parametrize("action", [-1, 14, 2.0, "up", [0, 1]])
def test_an_invalid_action_is_rejected(env, action):
    _, state = reset_once(env)
    with pytest.raises(ValueError, match="0 to 13"):
        env.step(jax.random.key(0), state, action)


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("C", {}, "env must be one of A, B, got 'C'"),
        ("A", {"physics": "bullet"}, "physics must be one of auto, native, .* got 'bullet'"),
        ("A", {"colour": "red"}, "unknown option 'colour'"),
        ("A", {"observation": "smell"}, "observation must be one of rgb, .* got 'smell'"),
        ("A", {"reward": "candy"}, "unknown reward 'candy': known are paper, completion"),
        ("A", {"task": "pour"}, "unknown task 'pour'"),
        ("A", {"size": (0, 64)}, r"size must be a tuple of two values, .* got \(0, 64\)"),
        ("A", {"max_steps": 0}, "max_steps must be a whole number of at least 1, got 0"),
        ("A", {"joint_noise": 90.0}, "joint_noise_scale must be at most 45 degrees, got 90"),
        ("B", {"joint_noise_scale": 3.0}, "joint_noise_scale must be at most 45 degrees, got 60"),
        ("B", {"joint_noise": -1.0}, "joint_noise must be"),
        ("A", {"camera": "back"}, "back"),
        ("A", {"camera": ()}, "camera must name at least one camera"),
        ("A", {"scene": "kitchen"}, "unknown scene 'kitchen'"),
    ],
)
def test_bad_options_are_rejected_in_one_sentence(name, options, message):
    with pytest.raises(ValueError, match=message) as raised:
        mjx_arm.make(name, **options)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("reward", "message"),
    [
        ("os:path", "the reward 'os:path' must be a function .*, got module"),
        (
            "mjx_arm.envs.tasks.lift:paper_reward",
            "fails when called with .*: TypeError: .* missing",
        ),
        ("json:dumps", r"'json:dumps' fails when called with \(before, after, action\): TypeError"),
        (lambda *step: [1.0], "must return a dict of named terms, each .*, got list"),
        (
            lambda *step: {"far": jnp.zeros(3)},
            r"term 'far' must be \[\] float32, got \[3\] float32",
        ),
        (lambda *step: {"near": True}, r"term 'near' must be \[\] float32, got \[\] bool"),
        (lambda *step: {"none": None}, r"term 'none' must be \[\] float32, got NoneType"),
        (lambda *step: {"text": "much"}, r"term 'text' must be \[\] float32, got str"),
        (lambda *step: {3: jnp.zeros(())}, "must name its terms by text, got 3"),
        (lambda before, after, action: after.measured["hight"], "fails when .* KeyError: 'hight'"),
    ],
)
def test_a_reward_that_returns_no_terms_is_rejected_by_name(reward, message):
    with pytest.raises(ValueError, match=message) as raised:
        mjx_arm.make("A", reward=reward, physics="native", observation="state")
    assert "\n" not in str(raised.value)


def test_a_reward_may_return_plain_numbers():
    reward = lambda before, after, action: {"one": 1.0, "high": 2.0 * after.measured["height"]}  # noqa: E731
    env = mjx_arm.make("A", reward=reward, physics="native", observation="state")
    _, state = jax.eval_shape(env.reset, jax.random.key(0))
    reward = jax.eval_shape(env.step, jax.random.key(0), state, jnp.int32(0))[2]
    assert (reward.shape, reward.dtype) == ((), jnp.float32)


def test_a_scene_without_the_names_of_the_task_is_rejected(tmp_path):
    path = tmp_path / "ball.xml"
    path.write_text('<mujoco><worldbody><geom type="sphere" size="1"/></worldbody></mujoco>')
    assert mjx_arm.load_scene(path).mj_model.ngeom == 1
    with pytest.raises(
        ValueError, match="at least one servo of a joint, and one actuator named 'gripper'"
    ):
        mjx_arm.make("A", scene=str(path))


def test_the_environments_are_the_papers():
    a, b = mjx_arm.EnvConfig(env="A"), mjx_arm.EnvConfig(env="B")
    assert (a.noise_degrees, a.placed) == (0.0, "fixed")
    assert (b.noise_degrees, b.placed) == (20.0, "after_success")


def test_configuration_is_frozen():
    config = mjx_arm.EnvConfig()
    with pytest.raises(dataclasses.FrozenInstanceError):
        config.env = "B"


def test_public_names_are_documented():
    for name in mjx_arm.__all__:
        assert inspect.getdoc(getattr(mjx_arm, name))
