"""The parts of the page about agents: their figures name the files and the seed they are from."""

from __future__ import annotations

import json

import pytest
from made_cells import MACHINE

from mjx_arm.reproduce import page
from mjx_arm.reproduce.agent_sections import table1
from mjx_arm.reproduce.blocks import Source, Table, Text
from mjx_arm.reproduce.plan import make_plan
from mjx_arm.reproduce.store import Measured

RESULT = {
    "env_steps": 1_234_567,
    "episodes": 1_000,
    "successes": 900,
    "held_not_lifted": 10,
    "first_episodes": 50,
    "first_successes": 41,
}
FILE = "cells/episodes-taught-B-seed0-in-B.json"


@pytest.fixture
def plan(tmp_path):
    """The shipped agents, of which one was tried in B, and the other on the same machine."""
    made = make_plan(tmp_path / "page", runs=None, shipped=True, quick=False, only=())
    made.store.prepare()
    for name, machine in (
        ("episodes-taught-B-seed0-in-B", MACHINE),
        ("episodes-taught-A-seed0-in-B", MACHINE | {"mjx_arm": "0.2.0"}),
    ):
        (cell,) = [cell for cell in made.cells if cell.name == name]
        inputs = json.loads(json.dumps(cell.inputs()))
        made.store.write(Measured(name, "", inputs, RESULT, (), machine, 1.0, "2026-01-01"), {})
    return made


def test_the_agents_name_the_files_of_their_steps(plan):
    blocks = list(page._head(plan))
    (table,) = [block for block in blocks if isinstance(block, Table)]
    assert "1,234,567" in table.rows[1]
    assert [block for block in blocks if isinstance(block, Source)] == [Source((FILE,))]


def test_the_first_episodes_name_their_seed(plan):
    table = next(block for block in table1(plan) if isinstance(block, Table))
    assert "41 of 50, seed 0" in table.rows[-1]


def test_one_machine_is_described_once(plan):
    texts = [block for block in page._times(plan) if isinstance(block, Text)]
    assert len(texts) == 1
    assert texts[0].text.startswith("Measured on a processor, 2 cores")
