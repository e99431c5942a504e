from __future__ import annotations

import os

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

import mjx_arm.interop
from mjx_arm.envs import tasks
from mjx_arm.envs.tasks.reach import Reach, ReachConfig

OPTIONS = {"physics": "native", "size": (16, 16), "max_steps": 4}
SHOULDER_UP = 2
A, B = "mjx_arm/ArmCubeA-v0", "mjx_arm/ArmCubeB-v0"


# Depth has no bound where nothing is hit, and a cube may fall for ever.
@pytest.mark.filterwarnings("ignore:.*A Box observation space m.*imum value is:UserWarning")
@pytest.mark.parametrize("observation", ["rgb", "rgbd", "segmentation", "packed", "state"])
def test_gymnasiums_checker_has_no_complaint(observation):
    env = gymnasium.make(A, observation=observation, render_mode="rgb_array", **OPTIONS)
    check_env(env.unwrapped)
    env.close()


def test_episodes_end_by_themselves():
    env = gymnasium.make(A, **OPTIONS)
    env.reset(seed=0)
    ends = [env.step(0)[2:4] for _ in range(4)]
    assert ends == [(False, False)] * 3 + [(False, True)]


def test_a_picture_is_bigger_than_what_the_agent_sees():
    env = gymnasium.make(A, render_mode="rgb_array", **OPTIONS)
    env.reset(seed=0)
    picture = env.render()
    assert (picture.shape, picture.dtype) == ((256, 256, 3), np.uint8)
    assert picture.std() > 5


def test_the_cube_outlives_a_failed_episode_but_not_a_seed():
    env = gymnasium.make(B, observation="state", **OPTIONS)
    places = [env.reset(seed=seed)[0][11:13] for seed in (1, None, 1, 2)]
    np.testing.assert_array_equal(places[0], places[1])
    np.testing.assert_array_equal(places[0], places[2])
    assert (places[0] != places[3]).all()


@pytest.mark.parametrize(
    ("action", "message"), [(14, "got 14"), (-1, "got -1"), (2.5, "got 2.5"), ([1, 2], "got")]
)
def test_invalid_actions_are_rejected(action, message):
    env = mjx_arm.interop.ArmCubeEnv(**OPTIONS)
    env.reset(seed=0)
    with pytest.raises(
        ValueError, match=f"actions must be one whole number from 0 to 13, {message}"
    ):
        env.step(action)


# Python and jax warn of a fork.
@pytest.mark.filterwarnings("ignore:.*fork.*")
@pytest.mark.skipif(not hasattr(os, "fork"), reason="there is no fork here")
@pytest.mark.parametrize("kind", ["ArmCubeEnv", "ArmCubeVectorEnv"])
def test_a_process_that_was_forked_from_one_with_jax_is_rejected(kind):
    make = getattr(mjx_arm.interop, kind)
    options = {"num_envs": 2} if kind == "ArmCubeVectorEnv" else {}
    ours, theirs = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            make("A", **options, **OPTIONS)
        except BaseException as error:
            os.write(theirs, f"{type(error).__name__}: {error}".encode())
        finally:
            os._exit(0)
    os.close(theirs)
    with os.fdopen(ours) as file:
        said = file.read()
    os.waitpid(child, 0)
    assert said.startswith("ValueError: this process was forked from one that runs jax")
    assert "context='spawn'" in said


def test_step_before_reset_is_rejected():
    for env in (mjx_arm.interop.ArmCubeEnv(**OPTIONS), vector_env()):
        with pytest.raises(ValueError, match="call reset first"):
            env.step(np.zeros(3, int))
    with pytest.raises(ValueError, match="unknown render_mode 'human'"):
        mjx_arm.interop.ArmCubeEnv(render_mode="human")


def vector_env(autoreset="next_step", **options):
    return gymnasium.make_vec(
        A,
        num_envs=3,
        vectorization_mode="vector_entry_point",
        autoreset=autoreset,
        observation="state",
        **OPTIONS | options,
    )


@pytest.mark.parametrize("autoreset", ["next_step", "same_step"])
def test_a_vector_env_resets_as_gymnasium_says(autoreset):
    env = vector_env(autoreset)
    assert env.metadata["autoreset_mode"] is AutoresetMode[autoreset.upper()]
    first, _ = env.reset(seed=0)
    assert env.observation_space.contains(first)
    steps = [env.step(np.full(3, SHOULDER_UP)) for _ in range(5)]
    assert all(env.observation_space.contains(obs) for obs, *_ in steps)
    ended = [step[3].tolist() for step in steps]
    obs, reward, *_, info = steps[3 if autoreset == "same_step" else 4]
    np.testing.assert_allclose(obs, first, atol=1e-6)
    assert ended[:3] == [[False] * 3] * 3
    assert ended[3] == [True] * 3
    if autoreset == "same_step":
        assert info["_final_obs"].all()
        assert info["_final_info"].all()
        np.testing.assert_array_equal(info["final_info"]["distance"], info["distance"])
        assert info["final_info"]["_distance"].all()
        # The arm has moved in the last observation, and is as at the start in the new one.
        last = np.stack(info["final_obs"])
        assert (np.abs(last - first).max(axis=-1) > 1e-3).all()
        assert (reward != 0).all()
    else:
        assert ended[4] == [False] * 3
        assert (reward == 0).all()
        assert not info["_grasped"].any()


def test_a_vector_env_does_what_single_ones_do():
    vector, single = vector_env(), gymnasium.make(A, observation="state", **OPTIONS)
    vector.reset(seed=0)
    single.reset(seed=0)
    for action in (2, 5, 13):
        obs, reward, *_ = vector.step(np.full(3, action))
        one, one_reward, *_ = single.step(action)
        np.testing.assert_allclose(obs, np.tile(one, (3, 1)), atol=1e-6)
        np.testing.assert_allclose(reward, one_reward, atol=1e-6)


def test_a_mask_restricts_the_reset_to_some_environments():
    env = vector_env()
    first, _ = env.reset(seed=0)
    for _ in range(2):
        moved, *_ = env.step(np.full(3, SHOULDER_UP))
    mask = np.asarray([True, False, True])
    obs, _ = env.reset(options={"reset_mask": mask})
    np.testing.assert_allclose(obs[mask], first[mask], atol=1e-6)
    np.testing.assert_array_equal(obs[~mask], moved[~mask])
    # The other episode goes on where it was: it ends after its own four steps.
    for _ in range(2):
        _, _, _, truncated, _ = env.step(np.full(3, SHOULDER_UP))
    assert truncated.tolist() == [False, True, False]
    with pytest.raises(ValueError, match="reset_mask must be 3 booleans"):
        env.reset(options={"reset_mask": np.ones(2, bool)})


@pytest.mark.parametrize("task", ["lift", "reach", "push"])
def test_each_task_is_registered(task):
    for name in ("A", "B"):
        made = gymnasium.make(f"mjx_arm/{task.title()}{name}-v0", observation="state", **OPTIONS)
        config = made.unwrapped.env.config
        assert (config.task, config.env) == (task, name)


@pytest.fixture
def later(monkeypatch):
    """Registers a task that leaves again with the test."""
    known = dict(tasks._tasks)
    monkeypatch.setattr(tasks, "_tasks", known)
    ids = dict(gymnasium.registry)
    yield lambda name, make: mjx_arm.register(name, make, config=ReachConfig, scene="arm_reach")
    for name in set(gymnasium.registry) - set(ids):
        del gymnasium.registry[name]


def test_a_task_that_is_registered_later_has_its_ids(later):
    later("point_there", Reach)
    later("point_there", Reach)  # once more is the same
    env = gymnasium.make("mjx_arm/PointThereB-v0", observation="state", **OPTIONS).unwrapped
    assert isinstance(env.env.task, Reach)
    assert (env.env.config.task, env.env.config.env) == ("point_there", "B")


def test_a_task_with_the_ids_of_another_is_rejected_and_not_registered(later):
    later("point_there", Reach)
    for name in ("arm_cube", "point__there"):
        with pytest.raises(ValueError, match=r"the gymnasium id 'mjx_arm/.*A-v0' of another task"):
            later(name, Reach)
        assert name not in tasks.task_names()
    assert gymnasium.spec("mjx_arm/ArmCubeA-v0").kwargs["task"] == "lift"


@pytest.mark.parametrize("name", ["", "own:task", "own task", "7"])
def test_a_name_that_cannot_be_an_id_is_rejected(name, later):
    with pytest.raises(ValueError, match="the name of a task must be a letter, then letters"):
        later(name, Reach)


def test_what_makes_no_task_is_rejected(later):
    with pytest.raises(ValueError, match="name must be text, got None"):
        later(None, Reach)
    with pytest.raises(ValueError, match=r"'made_up' must be made by a function .*, got 'Reach'"):
        later("made_up", "Reach")


def test_bad_vector_options_are_rejected():
    with pytest.raises(ValueError, match="num_envs must be a whole number of at least 1, got 0"):
        mjx_arm.interop.ArmCubeVectorEnv(num_envs=0)
    with pytest.raises(ValueError, match="unknown auto-reset mode"):
        mjx_arm.interop.ArmCubeVectorEnv(autoreset="never")
    env = vector_env()
    env.reset(seed=0)
    with pytest.raises(ValueError, match="actions must be 3 whole numbers from 0 to 13"):
        env.step(np.zeros(2, int))


@pytest.mark.peers
def test_stable_baselines3_takes_it_as_it_is():
    from stable_baselines3 import DQN
    from stable_baselines3.common.env_checker import check_env as check
    from stable_baselines3.common.env_util import make_vec_env

    options = OPTIONS | {"size": (36, 36)}
    check(mjx_arm.interop.ArmCubeEnv(**options))
    envs = make_vec_env(A, n_envs=2, env_kwargs=options)
    agent = DQN("CnnPolicy", envs, learning_starts=20, buffer_size=100, batch_size=4)
    agent.learn(60)
    assert agent.num_timesteps >= 60
    assert agent._n_updates > 0


@pytest.mark.peers
def test_stable_baselines3_takes_many_in_one_call():
    from stable_baselines3 import DQN

    from mjx_arm.interop.sb3 import ArmCubeVecEnv

    envs = ArmCubeVecEnv("A", 3, observation="state", **OPTIONS)
    envs.seed(0)
    first = envs.reset()
    assert first.shape == (3, *envs.observation_space.shape)
    steps = [envs.step(np.full(3, SHOULDER_UP)) for _ in range(4)]
    assert [ended.tolist() for _, _, ended, _ in steps] == [[False] * 3] * 3 + [[True] * 3]
    obs, _, _, infos = steps[-1]
    np.testing.assert_allclose(obs, first, atol=1e-6)
    assert all(info["TimeLimit.truncated"] and not info["success"] for info in infos)
    assert [info["is_success"] for info in infos] == [False] * 3
    # What an episode ended with is not what the next one begins with.
    assert np.abs(infos[0]["terminal_observation"] - first[0]).max() > 1e-3
    with pytest.raises(AttributeError, match="cannot be set"):
        envs.set_attr("env", None)
    images = ArmCubeVecEnv("A", 2, **OPTIONS | {"size": (36, 36)})
    agent = DQN("CnnPolicy", images, learning_starts=20, buffer_size=100, batch_size=4)
    agent.learn(60)
    assert agent._n_updates > 0
