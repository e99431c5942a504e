"""Where the benchmark of Figure 5 leaves its files, and at which level it reads."""

from __future__ import annotations

import json
import pathlib
import sys

import pytest

from mjx_arm.cli.standin import Deploy, Transfer

sys.path.insert(0, str(pathlib.Path(__file__).parents[2] / "benchmarks"))
import feature_maps


def test_no_true_level_is_read_unasked(tmp_path: pathlib.Path) -> None:
    options = feature_maps.make_parser().parse_args(["agent-a", "--out", str(tmp_path)])
    agent = pathlib.Path("agent-a")
    assert {options.level, Transfer(agent).level, Deploy(agent).level} == {"test"}


@pytest.mark.parametrize(
    ("option", "table", "picture"),
    [
        ("--out", "figure5.json", "figure5.png"),
        ("--page", "cells/figure5.json", "pictures/figure5.png"),
    ],
)
def test_the_files_are_in_the_folder_or_where_the_page_reads_them(
    tmp_path: pathlib.Path, option: str, table: str, picture: str
) -> None:
    folder = tmp_path / "out"
    options = feature_maps.make_parser().parse_args(["agent-a", option, str(folder)])
    rows = {"agent-a": {"mean": []}}
    assert feature_maps.write_files(options, rows, b"image") == folder / picture
    assert (folder / picture).read_bytes() == b"image"
    report = json.loads((folder / table).read_text())
    assert (report["level"], report["agents"]) == ("test", rows)
