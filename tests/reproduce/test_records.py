"""What became of an episode, worked out by hand from short made ones."""

from __future__ import annotations

import numpy as np
import pytest

from mjx_arm.reproduce.records import (
    cause_of,
    count_opens,
    height_histogram,
    marks_of,
    random_opens,
)
from mjx_arm.reproduce.rollouts import Rollout

OPEN, OTHER = 12, 0


def episode(grasped, height=None, distance=None, *, opens=(), success=False, diverged=False):
    """An episode whose agent never wants to open the gripper; `opens` are steps of random opens."""
    length = len(grasped)
    action = np.full(length, OTHER)
    action[list(opens)] = OPEN
    return Rollout(
        qpos=np.zeros((length + 1, 3), np.float32),
        action=action,
        greedy=np.full(length, OTHER),
        max_q=np.arange(length, dtype=np.float32),
        grasped=np.asarray(grasped, bool),
        height=np.asarray(height if height is not None else [0.0] * length, np.float32),
        distance=np.asarray(distance if distance is not None else [0.2] * length, np.float32),
        success=success,
        diverged=diverged,
        params={},
    )


@pytest.mark.parametrize(
    ("rollout", "cause"),
    [
        (episode([0, 1], success=True), None),
        (episode([0, 1], diverged=True), "diverged"),
        (episode([0, 0]), "never_reached"),
        (episode([0, 0], distance=[0.2, 0.039]), "not_grasped"),
        (episode([0, 1, 0]), "dropped_and_lost"),
        (episode([0, 1, 1]), "timed_out"),
    ],
)
def test_a_failure_has_one_cause(rollout, cause):
    assert cause_of(rollout) == cause


def test_a_random_open_on_the_table_a_catch_and_a_drop():
    lying = episode([1, 0, 1], [0.005, 0.0, 0.0], opens=[1])
    caught = episode([1, 0, 1], [0.2, 0.195, 0.195], opens=[1])
    dropped = episode([1, 0, 0, 1], [0.2, 0.1, 0.0, 0.0], opens=[1])
    lost = episode([1, 0, 0], [0.2, 0.1, 0.0], opens=[1])
    kinds = [random_opens(x, OPEN)[0] for x in (lying, caught, dropped, lost)]
    assert [each.kind for each in kinds] == ["on_the_table", "caught", "dropped", "dropped"]
    assert [each.again for each in kinds] == [True, True, True, False]


def test_an_open_that_the_agent_prefers_is_not_random():
    rollout = episode([1, 0], [0.2, 0.2], opens=[1])
    rollout.greedy[1] = OPEN
    assert random_opens(rollout, OPEN) == []


def test_an_open_without_a_grasp_is_not_counted():
    assert random_opens(episode([0, 0], opens=[1]), OPEN) == []


def test_opens_are_counted_over_episodes():
    finished = episode([1, 0, 1, 0, 1], [0.2, 0.0, 0.2, 0.0, 0.3], opens=[1, 3], success=True)
    lost = episode([1, 0], [0.2, 0.0], opens=[1])
    counts = count_opens([finished, lost], OPEN)
    assert counts["random_opens"] == 3
    assert counts["dropped"] == {"count": 3, "grasped_again": 2, "succeeded": 2}
    assert counts["caught"]["count"] == counts["on_the_table"]["count"] == 0
    assert counts["episodes_with_drop"] == 2
    assert counts["episodes_with_drop_succeeded"] == 1


def test_heights_are_of_grasped_steps_and_hovering_of_failures():
    failed = episode([0, 1, 1, 1], [0.25, 0.015, 0.25, 0.29])
    won = episode([1, 1], [0.25, 0.3], success=True)
    found = height_histogram([failed, won], 0.3)
    assert found["grasped_steps"] == sum(found["steps"]) == 5
    assert found["all_steps"] == 6
    assert found["steps"][1] == 1
    assert found["hovering_steps"] == 2


def test_five_frames_are_marked():
    rollout = episode(
        [0, 0, 0, 1, 0, 1, 1],
        [0.0, 0.0, 0.0, 0.0, 0.0, 0.1, 0.3],
        [0.2, 0.09, 0.02, 0.01, 0.01, 0.01, 0.01],
        success=True,
    )
    marks = {mark.name: mark.frame for mark in marks_of(rollout)}
    # Frame i + 1 is what step i led to.
    assert marks == {"start": 0, "approach": 2, "at the cube": 3, "grasped": 6, "lifted": 7}


def test_marks_do_not_run_backwards():
    rollout = episode([1, 1], [0.2, 0.3], [0.2, 0.2], success=True)
    frames = [mark.frame for mark in marks_of(rollout)]
    assert frames == sorted(frames)
