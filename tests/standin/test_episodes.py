from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from mjx_arm.export import export_policy
from mjx_arm.standin.episodes import Job, Runner, run_episodes
from mjx_arm.standin.levels import Offsets, find_level
from mjx_arm.tools.transfer import sample_starts
from mjx_arm.training.agent import load_agent

pytestmark = pytest.mark.usefixtures("opengl")


@pytest.fixture(scope="module")
def agent():
    return load_agent("agent-a")


@pytest.fixture(scope="module")
def job(agent) -> Job:
    return Job(agent.env, find_level("test"), export_policy(agent), 30, 0.2, seed=3)


def same(one, other) -> bool:
    pairs = zip(dataclasses.astuple(one), dataclasses.astuple(other), strict=True)
    return all(np.array_equal(x, y) for x, y in pairs)


@pytest.mark.slow
def test_an_episode_depends_on_its_number_and_start_alone(agent, job) -> None:
    starts = sample_starts(agent.env, 1, 2)
    runner = Runner(job)
    first, second = (runner.run(i, start) for i, start in enumerate(starts))
    assert same(runner.run(0, starts[0]), first)
    assert not np.array_equal(first.action, second.action)
    assert len(first.action) == 30
    assert len(first.distance) == len(first.height) == len(first.grasped) == 31
    runner.world.close()


@pytest.mark.slow
def test_processes_give_what_one_process_gives(agent, job) -> None:
    starts = sample_starts(agent.env, 1, 3)
    told: list[object] = []
    alone = run_episodes(job, starts, processes=0)
    shared = run_episodes(job, starts, processes=2, on_episode=told.append)
    assert all(same(x, y) for x, y in zip(alone, shared, strict=True))
    assert len(told) == 3


@pytest.mark.parametrize(
    ("count", "processes", "sentence"),
    [
        (0, 1, "the number of starts must be a whole number of at least 1, got 0"),
        (1, -1, "processes must be a whole number of at least 0 or None, got -1"),
    ],
)
def test_bad_numbers_are_rejected(count, processes, sentence) -> None:
    with pytest.raises(ValueError, match=sentence):
        run_episodes(None, [None] * count, processes=processes)


@pytest.mark.slow
def test_a_process_that_cannot_start_says_why(agent, job) -> None:
    broken = dataclasses.replace(job, policy=b"no policy")
    with pytest.raises(ValueError, match="the policy is no exported policy"):
        run_episodes(broken, sample_starts(agent.env, 1, 2), processes=2)


@pytest.mark.slow
def test_without_offsets_an_agent_succeeds_as_in_its_simulator(agent) -> None:
    """Nothing but the renderer is another one."""
    job = Job(agent.env, Offsets(), export_policy(agent), 400, 0.1, seed=3, shadows=False)
    traces = run_episodes(job, sample_starts(agent.env, 4, 6), processes=0)
    assert sum(trace.success for trace in traces) >= 4
