from __future__ import annotations

import numpy as np
import pytest
from rollouts import rollout, succeeded

import mjx_arm
from mjx_arm.envs.scripted import make_scripted_policy

# The share of environment B's starts from which the task must be shown to be possible.
LEAST_SUCCESS = 0.96
LENGTH = 500


@pytest.mark.parametrize(
    ("name", "physics", "num_envs"),
    [
        ("A", "native", 1),
        ("B", "native", 250),
        pytest.param("B", "native", 1000, marks=pytest.mark.slow),
        pytest.param("A", "mjx", 1, marks=pytest.mark.slow),
        pytest.param("B", "mjx", 50, marks=pytest.mark.slow),
    ],
)
def test_lifts_the_cube_with_the_fourteen_actions(name, physics, num_envs):
    env = mjx_arm.make(name, physics=physics, observation="state")
    policy = make_scripted_policy(env)
    states, transitions = rollout(
        env, lambda key, state: policy(state), num_envs=num_envs, length=LENGTH, seed=11
    )
    share = succeeded(transitions).mean()
    print(f"{name} {physics}: {share:.3f} of {num_envs} starts")
    assert share >= LEAST_SUCCESS
    done = np.argwhere(transitions.terminated)[0]
    height = states.physics.qpos[tuple(done)][env.task.cube_qpos + 2] - env.task.half_size
    assert height >= 0.3
