"""The benchmark for a GPU, rehearsed on a CPU."""

from __future__ import annotations

import base64
import importlib.metadata
import json
import os
import pathlib
import re
import subprocess
import sys
import textwrap
import zlib

import jax
import numpy as np
import pytest

import mjx_arm
from mjx_arm.config import set_train_options
from mjx_arm.report.machine import versions

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


def test_a_cell_that_has_no_figure_yet_is_not_measured(tmp_path):
    cells = {cell.name: cell for cell in gpu.CELLS[""]}
    training, trained = cells["training and driving at 8192"], cells["a"]
    gpu.append(tmp_path, training)({"failed": "no memory"})
    gpu.append(tmp_path, trained)({"judged": []})
    assert list(gpu.in_order(tmp_path, [trained, training])) == [trained, training]
    # What failed after its figure has one.
    write = gpu.append(tmp_path, trained)
    write({"judged": [{"rate": 0.5}]})
    write({"failed": "no memory"})
    assert gpu.read(tmp_path, "train-a")[-1]["judged"] == [{"rate": 0.5}]
    assert list(gpu.in_order(tmp_path, [trained, training])) == [training, trained]


def test_a_command_ends_in_the_middle_of_what_takes_too_long(tmp_path):
    program = f"""
import time
gpu._GRACE_S = 1
gpu.CELLS[""] = [gpu.Cell("slow", "device", lambda visit, write: time.sleep(600), 0)]
gpu.main(["--json", {str(tmp_path)!r}, "--minutes", "0.01"])
"""
    assert on_a_bare_machine(program) == "out of time: the last cell is not finished"


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


# Without these, and without matplotlib, which throughput.py needs for its plot alone.
BARE = """
    import sys
    absent = "orbax imageio_ffmpeg imageio tensorboardX gymnasium matplotlib".split()
    sys.modules |= dict.fromkeys(absent)
    sys.path.insert(0, "benchmarks")
    import gpu
"""


def on_a_bare_machine(code: str) -> str:
    """What a program prints that cannot import what a bare machine lacks."""
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(BARE) + code],
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_it_is_imported_on_a_bare_machine():
    assert on_a_bare_machine("print(len(gpu.CELLS))") == "3"


@pytest.mark.long
def test_it_measures_on_a_bare_machine(tmp_path):
    cells = ["device", "parity", "a", "physics+render at 8192", "training and driving at 8192"]
    arguments = ["--json", str(tmp_path), "--tiny", "--minutes", "30", "--cells", *cells]
    said = on_a_bare_machine(f"gpu.main({arguments!r})")
    assert said.count(" s\n") + 1 == len(cells)
    rows = [row for file in tmp_path.glob("*.json") for row in gpu.read(tmp_path, file.stem)]
    assert sorted(row["cell"] for row in rows) == sorted(cells)
    assert not [row for row in rows if "failed" in row]


def test_the_row_of_the_device_says_what_is_installed(tmp_path):
    cell = gpu.CELLS[""][0]
    cell.measure(gpu.Visit(tiny=True, deadline=0.0), gpu.append(tmp_path, cell))
    (row,) = gpu.read(tmp_path, "device")
    assert row["devices"] == jax.device_count()
    assert row["versions"]["jaxlib"] == importlib.metadata.version("jaxlib")
    assert row["versions"]["chex"] == importlib.metadata.version("chex")
    # No GPU here, or a driver with a number.
    assert row["driver"] is None or row["driver"][0].isdigit()


def test_what_is_not_there_is_none():
    assert versions("no-such-package")["no-such-package"] is None
    assert gpu.first_line(["no-such-program"]) is None
    assert gpu.first_line([sys.executable, "-c", "print(1); raise SystemExit(1)"]) is None
    assert gpu.first_line([sys.executable, "-c", "print(1); print(2)"]) == "1"


def test_parity_is_measured_with_each_stored_backend():
    pixels = np.zeros((1, 2, 2), np.uint32)
    data = base64.b64encode(zlib.compress(pixels.tobytes())).decode()
    images = {"shape": [1, 2, 2], "data": data}
    stored = {"machine": {"cpu": "X"}, "images": images}
    # Two iterations of one arm with two joints.
    stored["qpos"] = {"native": [[[0.0, 0.0]], [[0.0, 1.0]]], "mjx": [[[0.0, 0.5]], [[0.0, 1.0]]]}
    now = {"backend": "mjx", "images": images, "qpos": [[[0.0, 0.5]], [[0.25, 1.0]]]}
    row = gpu.compare(stored, now)
    assert row["largest_difference_of_qpos"] == {"native": 0.5, "mjx": 0.25}
    assert row["by_iteration"] == {"native": [0.5, 0.25], "mjx": [0.0, 0.25]}
    assert row["share_of_pixels_of_another_geom"] == row["largest_difference_of_colour"] == 0


@pytest.mark.slow
@pytest.mark.parametrize("physics", ["native", "mjx"])
def test_the_stored_values_are_those_of_this_code(physics):
    """If not, `benchmarks/gpu.py --store` writes them again."""
    row = gpu.compare(json.loads(gpu.STORED.read_text()), gpu.compute(physics))
    assert row["share_of_pixels_of_another_geom"] == 0
    assert row["largest_difference_of_colour"] <= 1
    assert row["largest_difference_of_qpos"][physics] <= 1e-6


def test_a_row_has_as_many_samples_a_step_as_the_preset():
    preset = mjx_arm.PRESETS["gpu"]
    options = gpu._with_own_ratio(8_192)
    config = set_train_options(preset, {"num_envs": 8_192, **options})
    assert config.samples_per_step == preset.samples_per_step == 4
    assert config.algo.student_batch_size == 2 * preset.algo.student_batch_size


def talker(program: str) -> subprocess.Popen[str]:
    """A process whose output is listened to."""
    command = [sys.executable, "-c", f"import time; {program}"]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)


@pytest.mark.parametrize(
    ("program", "seconds", "expected"),
    [
        ("print('other'); print('compiled', flush=True); time.sleep(60)", 30, True),
        ("print('other')", 30, False),
        ("time.sleep(60)", 0.1, False),
    ],
)
def test_a_process_is_ready_once_it_says_so(program, seconds, expected):
    with talker(program) as process:
        assert gpu.said(process, gpu._READY, seconds) == expected
        process.kill()


def test_two_processes_append_to_one_file(tmp_path):
    # The second begins before the first has written, as with `--ahead`.
    first, second = (gpu.append(tmp_path, gpu.CELLS[""][0], ahead=True) for _ in range(2))
    first({"value": 1})
    second({"value": 2})
    rows = gpu.read(tmp_path, "device")
    assert [row["value"] for row in rows] == [1, 2]
    assert all(row["compiled_ahead"] for row in rows)


def test_a_cell_of_its_own_process_is_measured(tmp_path, capsys):
    gpu.main(["--json", str(tmp_path), "--tiny", "--ahead", "--cells", "device"])
    assert re.fullmatch(r"device: \d+ s\n", capsys.readouterr().out)
    (row,) = gpu.read(tmp_path, "device")
    assert row["compiled_ahead"]


def test_a_cell_that_is_not_compiled_in_time_is_left_out(tmp_path, capsys):
    gpu.main(["--json", str(tmp_path), "--tiny", "--ahead", "--minutes", "0", "--cells", "device"])
    assert capsys.readouterr().out == "device: not compiled in time, or it failed\n"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.long
def test_cells_are_compiled_in_parallel_and_measured_in_their_order(tmp_path):
    cells = ["physics+render at 8192", "training and driving at 8192", "ray cast fenced"]
    command = ["--json", str(tmp_path), "--tiny", "--minutes", "30", "--ahead", "--cells", *cells]
    gpu.main(command)
    rows = [row for file in ("throughput", "comparisons") for row in gpu.read(tmp_path, file)]
    assert [row["cell"] for row in rows] == cells
    assert all(row["compiled_ahead"] and row["steps_per_s"] > 0 for row in rows)
    assert rows[1]["peak_bytes"] > 0


@pytest.mark.long
@pytest.mark.parametrize("only", ["", "b", "published"])
def test_every_cell_is_rehearsed(only, tmp_path):
    gpu.main(
        ["--json", str(tmp_path), "--tiny", "--minutes", "30", *(["--only", only] * bool(only))]
    )
    rows = [row for cell in gpu.CELLS[only] for row in gpu.read(tmp_path, cell.file)]
    assert {row["cell"] for row in rows} == {cell.name for cell in gpu.CELLS[only]}
    assert not [row for row in rows if "failed" in row]
