from __future__ import annotations

import json
import pathlib
import re
from typing import Any

import pytest
from doc_pages import ROOT
from results import FOLDERS, RESULTS, TABLES, render, task_command

import mjx_arm
from mjx_arm.cli.parse import parse
from mjx_arm.config import dump_config
from mjx_arm.report.machine import machine


@pytest.mark.parametrize("name", TABLES)
def test_a_table_has_its_file_its_machine_and_equal_rows(name: str):
    text = render(name)
    file = TABLES[name][0]
    assert f": `benchmarks/results/{file}`." in text
    if (RESULTS / file).is_file():
        about = json.loads((RESULTS / file).read_text()).get("machine")
        assert about is None or about["cpu"] in text
    else:
        assert file in FOLDERS
    rows = [line for line in text.splitlines() if line.startswith("|")]
    assert len(rows) > 2
    assert len({row.count("|") for row in rows}) == 1


@pytest.mark.parametrize("name", TABLES)
def test_a_table_says_what_machine_it_is_from(name: str):
    """Below it, or in a column with a cell for each row."""
    text = render(name)
    header, _, *rows = (line for line in text.splitlines() if line.startswith("|"))
    columns = [cell.strip() for cell in header.strip("|").split("|")]
    if not re.search(r"^Machine: .+, \d+ cores, ", text, re.MULTILINE):
        assert {"machine", "device"} & set(columns)
        column = next(i for i, cell in enumerate(columns) if cell in ("machine", "device"))
        assert all(row.strip("|").split("|")[column].strip() for row in rows)


def test_the_version_is_named_where_a_file_has_it(tmp_path: pathlib.Path):
    about = {"cpu": "X", "cores": 2, "mjx_arm": "0.2.0", "jax": "1", "mujoco": "2"}
    content = {"machine": about, "median": {"cold": 1.0}, "all": {"cold": [1.0]}}
    (tmp_path / "cold_start.json").write_text(json.dumps(content))
    assert "Machine: X, 2 cores, mjx_arm 0.2.0, jax 1, mujoco 2." in render("cold-start", tmp_path)
    assert machine()["mjx_arm"] == mjx_arm.__version__


def test_ratios_of_versions_have_their_interval(tmp_path: pathlib.Path):
    about = {"cpu": "X", "cores": 2, "jax": "1", "mujoco": "2"}
    row = {"stage": "physics", "before": 66177, "after": 51995, "ratio": 0.796}
    content = {"machine": about, "commits": {"before": "abc", "after": "def"}}
    content["rows"] = [row | {"low": 0.732, "high": 0.822}]
    (tmp_path / "before_after.json").write_text(json.dumps(content))
    text = render("before-after", tmp_path)
    assert "| before, per s (commit `abc`) | after, per s (commit `def`) |" in text
    assert "| physics | 66,177 | 51,995 | 0.80 (0.73 to 0.82) |" in text


def test_tasks_have_their_figures(tmp_path: pathlib.Path):
    row = {
        "task": "reach",
        "minutes": 3.12,
        "evaluation": {"rate": 0.977, "ci95": [0.9657, 0.9846]},
        "machine": {"cpu": "X", "cores": 2, "mjx_arm": "0.2.0", "jax": "1", "mujoco": "2"},
        "config": {"env": {"task": "reach", "env": "B"}, "total_steps": 500_000},
    }
    (tmp_path / "tasks.json").write_text(json.dumps({"rows": [row]}))
    assert (
        "| reach | 3.1 | 97.7 % (96.6 to 98.5) | X, 2 cores, mjx_arm 0.2.0, jax 1, mujoco 2 "
        "| `mjx-arm train --preset state --task reach --env B --total-steps 500000` |"
    ) in render("tasks", tmp_path)


def test_the_command_of_a_task_has_the_options_of_its_training():
    for row in json.loads((RESULTS / "tasks.json").read_text())["rows"]:
        config = parse(task_command(row["config"]).split()[1:])[0].options
        made = _flat(json.loads(json.dumps(dump_config(config))))
        trained = _flat(row["config"])
        # The backend that a run takes depends on its device, and is written into its file.
        made["env.physics"] = trained["env.physics"]
        assert {name: made[name] for name in trained} == trained


def _flat(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    found = {}
    for name, x in values.items():
        own = _flat(x, f"{prefix}{name}.") if isinstance(x, dict) else {f"{prefix}{name}": x}
        found.update(own)
    return found


def test_figures_are_those_of_the_file(tmp_path: pathlib.Path):
    about = {"cpu": "X", "cores": 2, "jax": "1", "mujoco": "2"}
    content = {"machine": about, "median": {"cold": 16.53}, "all": {"cold": [16.72, 16.53]}}
    (tmp_path / "cold_start.json").write_text(json.dumps(content))
    text = render("cold-start", tmp_path)
    assert "| cold | 16.5 | 16.7, 16.5 |" in text
    assert "Machine: X, 2 cores, jax 1, mujoco 2." in text


def test_what_is_missing_is_not_measured(tmp_path: pathlib.Path):
    about = {"cpu": "X", "cores": 2, "jax": "1", "mujoco": "2"}
    row = {"num_envs": 16, "stage": "physics", "shadows": False, "steps_per_s": 1234}
    rows = [row, row | {"num_envs": 64, "stage": "render"}]
    (tmp_path / "throughput.json").write_text(json.dumps({"machine": about, "rows": rows}))
    text = render("throughput", tmp_path)
    assert "| environments | physics, steps/s | rendering, steps/s |" in text
    assert "| 16 | 1,234 | not measured |" in text
    assert "| 64 | not measured | 1,234 |" in text


def test_an_unknown_table_is_rejected():
    with pytest.raises(ValueError, match="results must name one of throughput"):
        render("none")


def test_a_file_that_was_measured_once_may_not_be_missing(tmp_path: pathlib.Path):
    with pytest.raises(FileNotFoundError):
        render("throughput", tmp_path)


def test_figures_of_a_gpu_that_are_missing_are_not_measured(tmp_path: pathlib.Path):
    text = render("gpu", tmp_path)
    for line in (
        "| environment A to 95 % | 3 minutes | not measured | not measured |",
        "| environment B to 90 % | 5 minutes | not measured | not measured |",
        "| physics and rendering of 8,192 environments | 400,000 steps/s | not measured |",
        "| training of 8,192 environments, larger batches | 100,000 steps/s | not measured |",
        "| memory of the training of 1,024 environments |  | not measured | not measured |",
        "| physics alone of 8,192 environments, MJX-Warp |  | not measured | not measured |",
        "| training with Squint's published settings |  | not measured | not measured |",
    ):
        assert line in text


def test_figures_of_a_gpu_are_those_of_its_files(tmp_path: pathlib.Path):
    machine = {"machine": {"device": "H100"}}

    def judged(*rates: float) -> dict[str, object]:
        rows = [
            {"minutes": 1.25 * (i + 1), "rate": rate, "env_steps": 9_000_000 * (i + 1)}
            for i, rate in enumerate(rates)
        ]
        return {"cell": "a", "judged": rows, **machine}

    def write(file: str, *rows: dict[str, object]) -> None:
        (tmp_path / "gpu" / f"{file}.json").write_text(json.dumps({"rows": rows}))

    (tmp_path / "gpu").mkdir()
    # The second run was stopped before; the third one failed.
    write("train-a", judged(0.5, 0.95, 0.97), judged(0.5, 0.9), {"failed": "no memory", **machine})
    rate = {"cell": "physics+render at 8192", "steps_per_s": 512_345, **machine}
    training = rate | {
        "cell": "training and driving at 8192",
        "steps_per_s": 421_260,
        "samples_per_step": 2.0,
        "planned_bytes": 2_816_193_048,
        "peak_bytes": 3_100_000_000,
    }
    # It failed after it had a figure.
    write("throughput", rate, training | {"failed": "no memory"})
    write(
        "comparisons", rate | {"cell": "physics mjx"}, {"cell": "physics mjx-warp", "left_out": 1}
    )
    text = render("gpu", tmp_path)
    assert "| 3 minutes | 2.5 minutes, 90 % in 2.5 minutes | H100 |" in text
    assert "| environment B to 90 % | 5 minutes | not measured |" in text
    assert "| 400,000 steps/s | 512,345 steps/s | H100 |" in text
    assert "| images and a motion beside those of a CPU | equal | not measured |" in text
    # From the first evaluation to the last: 18 and 9 million steps in 2.5 and 1.25 minutes.
    assert "| 100,000 steps/s | 120,000 steps/s, 120,000 steps/s | H100 |" in text
    assert (
        "training of 8,192 environments |  | 421,260 steps/s with 2 samples for each step | H100 |"
        in text
    )
    assert "environments | 2.82 GB planned | 3.10 GB | H100 |" in text
    # That one trains on fewer samples for each step than the preset.
    assert "larger batches | 100,000 steps/s | not measured |" in text
    assert "| physics alone of 8,192 environments, MJX |  | 512,345 steps/s | H100 |" in text
    assert "| physics alone of 8,192 environments, MJX-Warp |  | not measured |" in text


def test_a_gpu_is_compared_with_a_cpu(tmp_path: pathlib.Path):
    row = {
        "share_of_pixels_of_another_geom": 0.0005,
        "largest_difference_of_colour": 2,
        "largest_difference_of_qpos": {"native": 3e-6, "mjx": 2e-7},
        "machine": {"device": "H100"},
    }
    (tmp_path / "gpu").mkdir()
    (tmp_path / "gpu" / "parity.json").write_text(json.dumps({"rows": [row]}))
    text = render("gpu", tmp_path)
    assert "| 0.050 % of the pixels show another geom, the others differ by 2 of 255" in text
    assert "qpos by 3e-06 rad or m after 20 iterations | H100 |" in text


def test_processes_are_compared(tmp_path: pathlib.Path):
    row = {"variant": "1 process, 1 core", "steps_per_s": 1000, "least": 900, "most": 1100}
    two = row | {"variant": "2 processes, a core each", "exchange": 0.254}
    machine = {"cpu": "X", "cores": 2, "jax": "1", "mujoco": "2"}
    content = {"machine": machine, "rows": [row | {"exchange": None}, two]}
    (tmp_path / "processes.json").write_text(json.dumps(content))
    text = render("processes", tmp_path)
    assert "| 1 process, 1 core | 1,000 | 900 to 1,100 | nothing to exchange |" in text
    assert "| 1 process, 2 cores | not measured |" in text
    assert "| 2 processes, a core each | 1,000 | 900 to 1,100 | 25 % |" in text
    assert "Machine: X, 2 cores, jax 1, mujoco 2." in text


def test_every_table_is_on_a_page():
    names = ("agents.md", "benchmarks.md", "scaling.md")
    pages = "".join((ROOT / "docs" / page).read_text() for page in names)
    for name in TABLES:
        assert f"```{{results}} {name}\n" in pages
