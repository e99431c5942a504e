"""The table of the paper's questions: its files, and how often an agent may be read."""

from __future__ import annotations

import json
import pathlib
import shutil
import sys

import pytest

from mjx_arm.training.agent import find_agent

sys.path.insert(0, str(pathlib.Path(__file__).parents[2] / "benchmarks"))
import transfer


def test_an_agent_is_read_three_times_under_whatever_name(tmp_path: pathlib.Path) -> None:
    copy = tmp_path / "copy.safetensors"
    shutil.copy(find_agent(pathlib.Path("agent-a")), copy)
    for name, agent in (("one", "agent-a"), ("two", str(copy)), ("one", "agent-a")):
        transfer.note_reading(tmp_path, name, agent, levels=["near"])
    with pytest.raises(ValueError, match="agent-a has been read at true levels 3 times: 20"):
        transfer.note_reading(tmp_path, "three", "agent-a", levels=["far"])
    transfer.note_reading(tmp_path, "other", "agent-b", levels=["far"])
    readings = json.loads((tmp_path / "transfer.json").read_text())["readings"]
    assert [reading["agent"] for reading in readings] == ["one", "two", "one", "other"]
    assert len({reading["sha256"] for reading in readings}) == 2


def test_a_cell_has_a_file_and_replaces_its_older_self(tmp_path: pathlib.Path) -> None:
    cell = {"agent": "a", "sha256": "1", "world": "near", "start": "home", "rate": 0.5}
    transfer.add_cell(tmp_path, cell)
    transfer.add_cell(tmp_path, cell | {"start": "in_grasp"})
    transfer.add_cell(tmp_path, cell | {"rate": 0.75})
    table = json.loads((tmp_path / "transfer.json").read_text())
    assert [(x["start"], x["rate"]) for x in table["cells"]] == [("in_grasp", 0.5), ("home", 0.75)]
    alone = json.loads((tmp_path / "cell-a-near-home.json").read_text())
    assert alone["rate"] == 0.75
    assert alone["machine"] == table["machine"]


def test_a_new_agent_of_an_old_name_has_a_table_of_its_own(tmp_path: pathlib.Path) -> None:
    cell = {"agent": "a", "sha256": "1", "world": "near", "start": "home", "rate": 0.5}
    transfer.add_cell(tmp_path, cell)
    transfer.add_cell(tmp_path, cell | {"agent": "b"})
    transfer.add_cell(tmp_path, cell | {"sha256": "2", "world": "far"})
    table = json.loads((tmp_path / "transfer.json").read_text())
    assert [(x["agent"], x["world"]) for x in table["cells"]] == [("b", "near"), ("a", "far")]
    files = sorted(path.name for path in tmp_path.glob("cell-*.json"))
    assert files == ["cell-a-far-home.json", "cell-b-near-home.json"]
