from __future__ import annotations

import pathlib

import jax.numpy as jnp
import pytest

from mjx_arm.training.agent import load_agent, shipped_agents
from mjx_arm.training.evaluate import evaluate
from mjx_arm.training.loop import EVALUATION, role_key

AGENTS = pathlib.Path(__file__).parents[2] / "mjx_arm" / "agents"


def test_each_shipped_agent_is_small_and_has_a_card():
    assert shipped_agents() == ["agent-a", "agent-b"]
    for name in shipped_agents():
        assert (AGENTS / f"{name}.safetensors").stat().st_size <= 3 * 2**20
        assert "of 1,000 held-out episodes" in (AGENTS / f"{name}.md").read_text()


def test_an_unknown_agent_is_rejected_with_the_names_of_those_shipped():
    with pytest.raises(ValueError, match="or one of agent-a, agent-b"):
        load_agent("agent-z")


# Environment in which an agent is judged -> the least that its 95 % interval may begin with.
LEAST = {"agent-a": ("A", 0.91), "agent-b": ("B", 0.88)}


def judge(agent, apply, episodes):
    key = role_key(11, EVALUATION)
    return evaluate(agent.env, apply, agent.params, episodes=episodes, epsilon=0.1, key=key)


@pytest.mark.slow
@pytest.mark.parametrize("name", LEAST)
def test_an_agent_lifts_the_cube_because_of_what_it_sees(name):
    env, least = LEAST[name]
    agent = load_agent(name, env=env)
    assert judge(agent, agent.apply, 100).ci95[0] >= least
    blank = judge(agent, lambda params, obs: agent.apply(params, jnp.zeros_like(obs)), 50)
    assert blank.rate <= 0.02
    if env == "B":  # in A all episodes look alike at first
        other = judge(agent, lambda params, obs: agent.apply(params, jnp.roll(obs, 1, 0)), 50)
        assert other.rate <= 0.1
