from __future__ import annotations

import json

import imageio.v3 as imageio
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import mjx_arm
from mjx_arm.cli import main
from mjx_arm.envs.tasks.lift import grasped
from mjx_arm.kinematics import Poses
from mjx_arm.standin.episodes import Trace
from mjx_arm.tools.transfer import in_simulation, sample_starts, summarise
from mjx_arm.training.agent import load_agent

OPEN, CLOSE = 12, 13


@pytest.fixture(scope="module")
def env():
    return mjx_arm.make("A")


def trace(distance, height, grasped, action, success) -> Trace:
    return Trace(
        np.asarray(distance, float),
        np.asarray(height, float),
        np.asarray(grasped, bool),
        np.asarray(action),
        success,
    )


def test_episodes_are_counted_by_hand(env) -> None:
    lifted = trace(
        [0.1, 0.03, 0.02, 0.02, 0.02], [0, 0, 0, 0.1, 0.3], [0, 0, 0, 1, 1], [0, 0, CLOSE, 1], True
    )
    # Near with the open gripper twice, closes once; opens, and loses the cube at 2 cm.
    dropped = trace(
        [0.02, 0.02, 0.02, 0.02, 0.05],
        [0, 0, 0, 0.02, 0.0],
        [0, 0, 1, 1, 0],
        [0, CLOSE, 1, OPEN],
        False,
    )
    never_closed = trace([0.02, 0.02, 0.04], [0, 0, 0], [0, 0, 0], [0, 1], False)
    away = trace([0.2, 0.2], [0, 0], [0, 0], [CLOSE], False)
    found = summarise([lifted, dropped, never_closed, away], env)
    assert (found.episodes, found.successes, found.rate) == (4, 1, 0.25)
    assert found.ci95 == pytest.approx((0.0456, 0.6994), abs=1e-3)
    assert found.reached == 0.75
    # lifted: steps 1 and 2; dropped: 0 and 1; never_closed: 0 and 1.
    assert found.close_rate == pytest.approx(2 / 6)
    assert found.closed == pytest.approx(2 / 3)
    assert found.close_distance == pytest.approx(0.02)  # both grasps were closed there
    assert (found.grasped, found.dropped) == (0.5, 0.25)
    assert found.mean_length == pytest.approx((4 + 4 + 2 + 1) / 4)


def test_an_agent_that_closes_further_out_is_seen_to_do_so(env) -> None:
    # Closes in vain at 9 cm, opens, closes at 4 cm, and has the cube two iterations later.
    far = trace(
        [0.09, 0.06, 0.04, 0.032, 0.031],
        [0, 0, 0, 0, 0.3],
        [0, 0, 0, 0, 1],
        [CLOSE, OPEN, CLOSE, 1],
        True,
    )
    missed = trace([0.05, 0.05, 0.05], [0, 0, 0], [0, 0, 0], [CLOSE, 1], False)
    found = summarise([far, missed], env)
    assert found.close_rate is None
    assert found.close_distance == pytest.approx(0.04)
    assert summarise([missed], env).close_distance is None


def test_a_gripper_that_starts_closed_has_no_rate_of_closing(env) -> None:
    held = trace([0.01, 0.01, 0.01], [0, 0.1, 0.3], [1, 1, 1], [1, 1], True)
    found = summarise([held], env)
    assert found.close_rate is None
    assert found.closed is None
    assert found.close_distance is None
    opened = trace([0.01] * 4, [0] * 4, [1, 1, 0, 0], [OPEN, 0, CLOSE], False)
    assert summarise([opened], env).close_rate == 0.5
    assert summarise([opened], env).dropped == 0.0


def test_starts_depend_on_the_seed(env) -> None:
    env = mjx_arm.make("B")
    one, same, other = (sample_starts(env, seed, 3) for seed in (1, 1, 2))
    assert all(np.array_equal(x.qpos, y.qpos) for x, y in zip(one, same, strict=True))
    assert not np.array_equal(one[0].qpos, other[0].qpos)
    assert not np.array_equal(one[0].qpos, one[1].qpos)


@pytest.mark.parametrize("start", ["home", "in_grasp"])
def test_starts_fit_the_cube_of_the_scene_whatever_training_varied(start) -> None:
    env = mjx_arm.make("A", randomisation="standard", start=start)
    task, data = env.task, mujoco.MjData(env.scene.mj_model)
    for found in sample_starts(env, 1, 4):
        if start == "home":
            assert found.qpos[task.cube_qpos + 2] == np.float32(task.half_size)
            continue
        data.qpos[:] = found.qpos
        mujoco.mj_kinematics(env.scene.mj_model, data)
        poses = Poses(*map(jnp.asarray, (data.geom_xpos, data.geom_xmat, data.site_xpos)))
        poses = poses.replace(geom_xmat=poses.geom_xmat.reshape(-1, 3, 3))
        assert grasped(task, poses, found.ctrl)


@pytest.mark.slow
def test_the_simulator_starts_from_the_same_starts() -> None:
    agent = load_agent("agent-b", start="in_grasp")
    traces = in_simulation(agent, 5, 4, iterations=40)
    starts = sample_starts(agent.env, 5, 4)
    for found, start in zip(traces, starts, strict=True):
        assert len(found.action) <= 40
        cube = start.qpos[agent.env.task.cube_qpos + 2] - agent.env.task.half_size
        assert found.height[0] == pytest.approx(float(cube), abs=1e-6)
        assert found.grasped[0]
    assert len({tuple(found.action) for found in traces}) == 4


@pytest.mark.slow
def test_an_agent_succeeds_in_its_simulator() -> None:
    found = summarise(in_simulation(agent := load_agent("agent-a"), 1, 12), agent.env)
    assert found.rate > 0.7
    assert found.grasped >= found.rate
    assert found.reached == 1.0
    assert found.close_distance is not None
    assert 0.0 < found.close_distance < 0.06  # more than the open fingers reach


@pytest.mark.slow
def test_the_command_says_how_far_an_agent_comes(tmp_path, capsys) -> None:
    video = tmp_path / "one.gif"
    options = ["--level", "test", "--episodes", "2", "--max-steps", "12", "--out", str(video)]
    assert main(["transfer", "agent-a", *options, "--start", "in_grasp", "--json"]) == 0
    printed = capsys.readouterr()
    report = json.loads(printed.out)
    assert "2 of 2 episodes" in printed.err
    assert report["episodes"] == 2
    assert report["start"] == "in_grasp"
    assert report["mean_length"] <= 12
    assert report["reached"] == 1.0
    frames = imageio.imread(video)
    assert len(frames) == 13
    assert frames[0].shape == (384, 768, 3)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--level", "close"], "unknown level 'close'"),
        (["--episodes", "0"], "episodes must be a whole number of at least 1"),
        (["--start", "above"], "start must be one of home, in_grasp"),
        (["--out", "video.txt"], "give a path ending in .mp4 or .gif"),
        (["--epsilon", "2"], "epsilon must be a finite number from 0 to 1"),
        (["--seed", "-1"], "seed must be from 0"),
        (["--scene", "nowhere"], "unknown scene 'nowhere'"),
        (["--scene", "arm_reach"], "cube"),
    ],
)
def test_bad_options_are_rejected_in_one_sentence(options, sentence, capsys) -> None:
    assert main(["transfer", "agent-a", *options]) == 2
    error = capsys.readouterr().err
    assert sentence in error
    assert error.count("\n") == 1
