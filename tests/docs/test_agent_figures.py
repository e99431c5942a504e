"""The success rates on the pages are those that `mjx-arm eval` wrote."""

from __future__ import annotations

import json
import pathlib
import re

import pytest

from mjx_arm.cli.parse import parse
from mjx_arm.config import set_train_options
from mjx_arm.options import flat_names, get_option
from mjx_arm.training.run_folder import load_config

ROOT = pathlib.Path(__file__).parents[2]
RESULTS = sorted((ROOT / "benchmarks" / "results").glob("agent-*/in_?.json"))


def percent(share: float) -> str:
    """With one digit behind the point, but 100 without."""
    return f"{100 * share:.1f}".replace("100.0", "100")


@pytest.mark.parametrize("path", RESULTS, ids=lambda path: f"{path.parent.name}-{path.stem}")
def test_each_page_has_the_rate_and_its_interval(path):
    result = json.loads(path.read_text())
    low, high = map(percent, result["ci95"])
    rate = f"{percent(result['rate'])} % ({low} to {high})"
    for page in ("README.md", "docs/paper.md"):
        assert rate in (ROOT / page).read_text(), page
    # The card names what the first parenthesis is.
    card = (ROOT / "mjx_arm" / "agents" / f"{path.parent.name}.md").read_text()
    card = re.sub(r"\(95 % interval ", "(", card)
    assert rate in card
    assert f"{result['successes']} of {result['episodes']:,}" in card


def test_every_shipped_agent_was_tried_in_both_environments():
    names = {path.stem for path in (ROOT / "mjx_arm" / "agents").glob("*.safetensors")}
    assert names
    assert {(path.parent.name, path.stem) for path in RESULTS} == {
        (name, f"in_{env}") for name in names for env in "AB"
    }


@pytest.mark.parametrize("env", ["a", "b"])
def test_the_command_of_a_card_trains_with_the_options_of_its_agent(env):
    card = (ROOT / "mjx_arm" / "agents" / f"agent-{env}.md").read_text()
    command = re.search(r"^\| command \| `mjx-arm (.*)` \|$", card, re.MULTILINE)[1]
    options = parse(command.split())[0].options
    config = load_config(ROOT / "benchmarks" / "results" / f"agent-{env}")
    # The run names the backend that `auto` meant.
    options = set_train_options(options, {"physics": config.env.physics})
    different = {
        name: (get_option(options, name), get_option(config, name))
        for name in flat_names(config)
        if get_option(options, name) != get_option(config, name)
    }
    assert different == {}
