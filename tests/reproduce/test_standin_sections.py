"""The parts of the page about the stand-in, from files as the benchmarks leave them."""

from __future__ import annotations

import json

import pytest

from mjx_arm.reproduce.page import write_pages
from mjx_arm.reproduce.plan import make_plan
from mjx_arm.reproduce.trials import agent_digest


@pytest.fixture
def plan(tmp_path):
    made = make_plan(tmp_path / "page", runs=None, shipped=True, quick=False, only=())
    made.store.prepare()
    return made


def text_of(plan):
    write_pages(plan)
    return (plan.store.folder / "index.md").read_text()


def write_report(plan, name, values):
    (plan.store.folder / "cells" / f"{name}.json").write_text(json.dumps(values))


def cell(name, agent, world, start, **changes):
    """What `benchmarks/transfer.py` writes, as far as the page reads it."""
    values = {"rate": 0.8, "ci95": [0.7, 0.9], "episodes": 200, "close_rate": 0.25}
    names = {"agent": name, "sha256": agent, "world": world, "start": start}
    return names | values | changes


def both(name, agent, world, **changes):
    grasp = cell(name, agent, world, "in_grasp", rate=0.99, close_rate=None, episodes=100)
    return [cell(name, agent, world, "home", **changes), grasp]


def test_transfer_shows_the_agents_and_names_what_is_missing(plan):
    sha256 = agent_digest("agent-b")
    cells = [
        *both("taught-B-seed0", sha256, "simulation"),
        *both("taught-B-seed0", sha256, "near", close_rate=None),
        *both("another", "0", "far"),
    ]
    write_report(plan, "transfer", {"cells": cells, "readings": []})
    text = text_of(plan)
    row = "80.0 % of 200 | 70.0 to 90.0"
    grasp = "99.0 % of 100 | 70.0 to 90.0 |"
    assert f"| taught-B-seed0 | simulation | {row} | 25.0 % | {grasp}" in text
    assert f"| taught-B-seed0 | near | {row} | – | {grasp}" in text
    assert f"| another | far | {row} | 25.0 % | {grasp}" in text
    assert "`cells/transfer.json`" in text
    script = "python benchmarks/transfer.py"
    assert f"{script} taught-B-seed0=agent-b --levels medium far --out" in text
    assert f"{script} taught-A-seed0=agent-a --levels near medium far --out" in text


def test_transfer_of_an_earlier_agent_of_the_same_name_is_missing(plan):
    write_report(plan, "transfer", {"cells": both("taught-B-seed0", "0", "near"), "readings": []})
    text = text_of(plan)
    assert "| taught-B-seed0 | near |" not in text
    assert "The transfer of `taught-A-seed0`, `taught-B-seed0`: simulation, near, medium" in text


def compared(**agents):
    """What `benchmarks/feature_maps.py` writes, as far as the page reads it."""
    layers = [{"name": "PatchConv_0", "similarity": 0.98765, "other_moments": 0.9}]
    made = {name: {"sha256": sha256, "mean": layers} for name, sha256 in agents.items()}
    return {"level": "test", "agents": made}


def test_figure_5_has_its_picture_and_its_table(plan):
    names = {"taught-A-seed0": "agent-a", "taught-B-seed0": "agent-b"}
    shas = {name: agent_digest(agent) for name, agent in names.items()}
    write_report(plan, "figure5", compared(**shas))
    assert "**Missing.** Figure 5" in text_of(plan)
    (plan.store.folder / "pictures" / "figure5.png").write_bytes(b"image")
    text = text_of(plan)
    assert "(pictures/figure5.png)" in text
    assert "at level `test`" in text
    assert "| taught-B-seed0 | PatchConv_0 | 0.988 | 0.900 |" in text
    assert "`cells/figure5.json`" in text
    assert "**Missing.** Figure 5" not in text
    write_report(plan, "figure5", compared(**shas | {"taught-B-seed0": "0"}))
    text = text_of(plan)
    assert "| PatchConv_0 |" not in text
    assert "**Missing.** Figure 5 of `taught-A-seed0`, `taught-B-seed0`." in text


@pytest.mark.parametrize("name", ["figure5", "transfer"])
@pytest.mark.parametrize("content", ["", "[]", '{"agents": {"a": 1}, "cells": [1]}'])
def test_a_damaged_file_is_named(plan, name, content):
    (plan.store.folder / "pictures" / "figure5.png").write_bytes(b"image")
    (plan.store.folder / "cells" / f"{name}.json").write_text(content)
    with pytest.raises(ValueError, match=rf"{name}\.json is damaged: remove it"):
        write_pages(plan)
