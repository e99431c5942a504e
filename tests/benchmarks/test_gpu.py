"""The benchmark for a GPU, rehearsed on a CPU."""

from __future__ import annotations

import json
import os
import pathlib
import subprocess
import sys
import textwrap

import pytest

sys.path.insert(0, str(pathlib.Path(__file__).parents[2] / "benchmarks"))
import gpu

ROOT = pathlib.Path(__file__).parents[2]


def test_the_results_are_at_most_eight_files():
    assert len({cell.file for cells in gpu.CELLS.values() for cell in cells}) <= 8


def test_cells_are_measured_once_before_any_is_measured_twice(tmp_path):
    cells = gpu.CELLS[""]
    assert list(gpu.in_order(tmp_path, cells)) == cells
    for cell in cells[:2]:
        gpu.append(tmp_path, cell)({"value": 1})
    assert list(gpu.in_order(tmp_path, cells)) == [*cells[2:], *cells[:2]]


def test_a_repeated_figure_is_appended_and_a_running_one_replaced(tmp_path):
    cell = gpu.CELLS[""][0]
    for value in (1, 2):
        write = gpu.append(tmp_path, cell)
        write({"value": 0})
        write({"value": value})
    assert [row["value"] for row in gpu.read(tmp_path, cell.file)] == [1, 2]
    assert json.loads((tmp_path / "device.json").read_text())["rows"][0]["machine"]["cores"] > 0


def test_a_cell_for_which_no_time_is_left_is_left_out(tmp_path, capsys):
    gpu.main(["--json", str(tmp_path), "--minutes", "0"])
    assert list(tmp_path.iterdir()) == []
    assert capsys.readouterr().out.count("left out") == len(gpu.CELLS[""])


def test_it_does_without_what_a_bare_machine_lacks():
    """Nor matplotlib, which throughput.py needs for its plot alone."""
    code = """
        import sys
        absent = "orbax imageio_ffmpeg imageio tensorboardX gymnasium matplotlib".split()
        sys.modules |= dict.fromkeys(absent)
        sys.path.insert(0, "benchmarks")
        import gpu
        print(len(gpu.CELLS))
    """
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code)],
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stdout.strip() == "3", done.stderr


@pytest.mark.long
@pytest.mark.parametrize("only", ["", "b", "published"])
def test_every_cell_is_rehearsed(only, tmp_path):
    gpu.main(
        ["--json", str(tmp_path), "--tiny", "--minutes", "30", *(["--only", only] * bool(only))]
    )
    rows = [row for cell in gpu.CELLS[only] for row in gpu.read(tmp_path, cell.file)]
    assert {row["cell"] for row in rows} == {cell.name for cell in gpu.CELLS[only]}
    assert not [row for row in rows if "failed" in row]
