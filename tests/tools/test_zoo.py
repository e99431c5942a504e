"""The agents that come with the package, as the command line lists them."""

from __future__ import annotations

import json
import pathlib
import re

import pytest

from mjx_arm.cli import main
from mjx_arm.tools.zoo import read_zoo
from mjx_arm.training.agent import shipped_agents


def test_every_shipped_agent_has_a_card_with_its_name():
    agents = read_zoo()
    assert [agent.name for agent in agents] == shipped_agents()
    for agent in agents:
        assert agent.card.startswith(f"# {agent.name}\n")


def test_success_is_that_of_the_evaluations():
    folder = pathlib.Path(__file__).parents[2] / "benchmarks" / "results"
    for agent in read_zoo():
        assert set(agent.results) == {"A", "B"}
        listed = agent.to_json()["results"]
        for env in agent.results:
            measured = json.loads((folder / agent.name / f"in_{env}.json").read_text())
            measured["ci95"] = tuple(measured["ci95"])
            assert listed[env].items() <= measured.items()


def test_agents_lists_them(capsys):
    assert main(["agents"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split() == ["name", "task", "env", "sees", "trained", "by", "steps", "success"]
    (line,) = [line for line in lines if line.startswith("agent-b ")]
    assert "64×64 pixels of front" in line
    assert "2,506,752" in line
    # The environment that it was trained in comes first, as on its card.
    assert re.search(r" \d\d\.\d % of 1,000 in B, \d\d\.\d % of 1,000 in A$", line)


def test_agents_prints_json(capsys):
    assert main(["agents", "--json"]) == 0
    listed = {agent["name"]: agent for agent in json.loads(capsys.readouterr().out)}
    assert listed["agent-b"]["env"] == "B"
    assert main(["agents", "agent-b", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == listed["agent-b"]


def test_agents_shows_a_card(capsys):
    assert main(["agents", "agent-b"]) == 0
    assert capsys.readouterr().out.startswith("# agent-b\n\n| | |\n| --- | --- |\n| task | `lift`")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["agent-x"], "unknown agent 'agent-x': did you mean 'agent-b'?"),
        (["agent-b", "agent-b"], "unexpected argument 'agent-b'"),
    ],
)
def test_bad_input_gets_one_sentence(arguments, message, capsys):
    assert main(["agents", *arguments]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
