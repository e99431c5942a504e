from __future__ import annotations

import pathlib

import pytest

from mjx_arm.training.agent import load_agent, shipped_agents
from mjx_arm.training.evaluate import evaluate
from mjx_arm.training.loop import EVALUATION, role_key

AGENTS = pathlib.Path(__file__).parents[2] / "mjx_arm" / "agents"


def test_each_shipped_agent_is_small_and_has_a_card():
    assert "agent-b" in shipped_agents()
    for name in shipped_agents():
        assert (AGENTS / f"{name}.safetensors").stat().st_size <= 3 * 2**20
        assert "of 1,000 held-out episodes" in (AGENTS / f"{name}.md").read_text()


def test_an_unknown_agent_is_refused_with_the_names_of_those_shipped():
    with pytest.raises(ValueError, match="or one of agent-b"):
        load_agent("agent-z")


@pytest.mark.slow
def test_agent_b_lifts_the_cube():
    agent = load_agent("agent-b", env="B")
    key = role_key(11, EVALUATION)
    result = evaluate(agent.env, agent.apply, agent.params, episodes=200, epsilon=0.1, key=key)
    assert result.ci95[0] >= 0.88
