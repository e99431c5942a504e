from __future__ import annotations

import json
import pathlib

import pytest
from doc_pages import ROOT
from results import RESULTS, TABLES, render


@pytest.mark.parametrize("name", TABLES)
def test_a_table_has_its_file_its_machine_and_equal_rows(name: str):
    text = render(name)
    file = TABLES[name][0]
    assert f"File: `benchmarks/results/{file}`." in text
    machine = json.loads((RESULTS / file).read_text()).get("machine")
    assert machine is None or machine["cpu"] in text
    rows = [line for line in text.splitlines() if line.startswith("|")]
    assert len(rows) > 2
    assert len({row.count("|") for row in rows}) == 1


def test_figures_are_those_of_the_file(tmp_path: pathlib.Path):
    machine = {"cpu": "X", "cores": 2, "jax": "1", "mujoco": "2"}
    content = {"machine": machine, "median": {"cold": 16.53}, "all": {"cold": [16.72, 16.53]}}
    (tmp_path / "cold_start.json").write_text(json.dumps(content))
    text = render("cold-start", tmp_path)
    assert "| cold | 16.5 | 16.7, 16.5 |" in text
    assert "Machine: X, 2 cores, jax 1, mujoco 2." in text


def test_what_is_missing_is_not_measured(tmp_path: pathlib.Path):
    machine = {"cpu": "X", "cores": 2, "jax": "1", "mujoco": "2"}
    row = {"num_envs": 16, "stage": "physics", "shadows": False, "steps_per_s": 1234}
    rows = [row, row | {"num_envs": 64, "stage": "render"}]
    (tmp_path / "throughput.json").write_text(json.dumps({"machine": machine, "rows": rows}))
    text = render("throughput", tmp_path)
    assert "| environments | physics, steps/s | rendering, steps/s |" in text
    assert "| 16 | 1,234 | not measured |" in text
    assert "| 64 | not measured | 1,234 |" in text


def test_an_unknown_table_is_refused():
    with pytest.raises(ValueError, match="results must name one of throughput"):
        render("none")


def test_every_table_is_on_the_page():
    page = (ROOT / "docs" / "benchmarks.md").read_text()
    for name in TABLES:
        assert f"```{{results}} {name}\n" in page
