"""The whole command in its quick form: trained, measured, written, and nothing measured twice."""

from __future__ import annotations

import json
import pathlib
import re

import pytest

from mjx_arm.cli import main

# What two pages of the same files may differ in.
TIMES = re.compile(r"Machine, versions and times.*", re.DOTALL)
ONLY = ("figure1", "figure2", "figure3", "episodes", "figure4")


def cells(out: pathlib.Path) -> dict[str, float]:
    return {path.name: path.stat().st_mtime for path in (out / "cells").glob("*.json")}


@pytest.mark.long
def test_an_agent_is_measured_and_the_page_is_the_same_again(tmp_path, capsys):
    """Of the shipped agents, which need no training."""
    root = pathlib.Path(__file__).parents[2] / "benchmarks" / "results"
    pages = []
    for name in ("one", "two"):
        # The same folder: its path is in the commands on the page.
        out = tmp_path / "page"
        if out.exists():
            out.rename(tmp_path / "before")
        arguments = ["--shipped", "--runs", str(root), "--quick", "--out", str(out)]
        assert main(["reproduce", *arguments, "--only", *ONLY]) == 0, name
        pages.append(TIMES.sub("", (out / "index.md").read_text()))
    assert pages[0] == pages[1]
    before = cells(out)
    capsys.readouterr()
    assert main(["reproduce", *arguments, "--only", *ONLY]) == 0
    assert "measuring" not in capsys.readouterr().out
    assert cells(out) == before
    found = json.loads((out / "cells" / "episodes-taught-B-seed0-in-B.json").read_text())
    assert found["result"]["episodes"] == 40
    assert found["result"]["rate"] > 0.5


@pytest.mark.long
def test_the_quick_page_is_whole(tmp_path, capsys):
    out = tmp_path / "page"
    assert main(["reproduce", "--quick", "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert re.search(r"trainings: \d+, about \d+ minutes", said)
    page = (out / "index.html").read_text()
    assert len(page) < 10_000_000
    images = re.findall(r"<img [^>]*>", page)
    assert len(images) >= 10
    assert all(re.search(r'src="data:[^"]+" alt="[^"]{10,}"', image) for image in images)
    assert "reward-published-seed0" in page
    assert "This is a quick run" in page
