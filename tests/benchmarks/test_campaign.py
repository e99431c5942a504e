"""Each part of the campaign at a small scale, and the table that it prints."""

from __future__ import annotations

import os
import pathlib
import random
import re
import shutil
import subprocess
import sys

import jax
import pytest
import quick_run
from jax.experimental.compilation_cache import compilation_cache

sys.path.insert(0, str(pathlib.Path(__file__).parents[2] / "benchmarks"))
import campaign

# Runs that have been made, by their options.
runs: dict[tuple[str, ...], pathlib.Path] = {}


def run_here(folder: pathlib.Path, options: list[str]) -> None:
    """Runs to the end in this process, or copies a run that did."""
    made = runs.setdefault(tuple(options), folder)
    if made is not folder:
        shutil.copytree(made, folder)
        return
    status, _, error = campaign.in_process("train", *options, "--out", folder)
    assert status == 0, error


def command(*arguments: str | pathlib.Path) -> list[str]:
    return [sys.executable, quick_run.__file__, "train", *map(str, arguments)]


@pytest.fixture(autouse=True, scope="module")
def quick(tmp_path_factory):
    """Short runs, which share what this process has compiled with those that it starts.

    Not in the folder of the other tests: a process that is killed may leave half a program.
    """
    folder, before = str(tmp_path_factory.mktemp("cache")), jax.config.jax_compilation_cache_dir
    with pytest.MonkeyPatch.context() as patch:
        for replaced in quick_run.REPLACED:
            patch.setattr(*replaced)
        patch.setattr(campaign, "run_to_end", run_here)
        patch.setattr(campaign, "command", command)
        # Without selections; 20 chunks, so that there are two checkpoints.
        options = ("--select-every", "0", "--chunk-steps", "200", "--total-steps", "4000")
        for what in ("TINY", "STATE"):
            patch.setattr(campaign, what, [*campaign.STATE, *options])
        patch.setenv("JAX_COMPILATION_CACHE_DIR", folder)
        patch.setenv("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.2")
        compilation_cache.reset_cache()
        jax.config.update("jax_compilation_cache_dir", folder)
        yield
        compilation_cache.reset_cache()
        jax.config.update("jax_compilation_cache_dir", before)


def check(rows: list[campaign.Row], *attempts: int) -> None:
    """Nothing broke in any row, and something was tried in each."""
    assert [row.failures for row in rows] == [[]] * len(rows)
    assert tuple(row.attempts for row in rows) == attempts


def test_flipped_bits_are_found(tmp_path):
    check(list(campaign.flips(tmp_path, 0.01)), 2, 1, 1, 1, 1)


def test_swapped_checkpoints_and_numbers_are_found(tmp_path):
    check(list(campaign.swaps(tmp_path, 0.01)), 3, 2)


def test_generated_configurations_are_taken_or_rejected_in_a_sentence(tmp_path, monkeypatch):
    def run_command(arguments: list[str]) -> subprocess.CompletedProcess[str]:
        return subprocess.CompletedProcess(arguments, *campaign.in_process(*arguments[2:]))

    # One start of Python for each would take most of the time.
    monkeypatch.setattr(campaign, "_run", run_command)
    check(list(campaign.options(tmp_path, 0.2)), 60, 12)


@pytest.mark.parametrize("observation", ["state", pytest.param("packed", marks=pytest.mark.long)])
def test_steps_with_nans_do_not_reach_the_parameters(observation, tmp_path):
    check(list(campaign.nans(tmp_path, 0.1, observation)), 3, 3)


def test_one_of_two_processes_in_a_folder_trains(tmp_path):
    check(list(campaign.locks(tmp_path, 0.1)), 1)


def test_a_killed_run_continues_to_the_same_bits(tmp_path):
    whole = tmp_path / "whole"
    run_here(whole, campaign.STATE)
    check([campaign.kill_runs("", whole, campaign.STATE, random.Random(0), 6.0, 1)], 1)


def test_the_memory_of_a_run_is_watched(tmp_path):
    (row,) = campaign.memory(tmp_path, 0.004)
    assert row.attempts == 1
    # A few seconds say nothing about how much memory it will need.
    first, second = re.fullmatch(r"(\d+) MB, then (\d+) MB", row.note).groups()
    assert int(first) > 100
    assert int(second) > 100


@pytest.mark.long
@pytest.mark.skipif(sys.platform != "linux" or os.geteuid() != 0, reason="mounting needs root")
def test_a_run_on_a_full_disk_continues_when_there_is_room(tmp_path):
    check(list(campaign.disks(tmp_path, 0.25)), 1)


@pytest.fixture
def parts(monkeypatch) -> None:
    """Two parts that are good, and one that crashes after its first row."""

    def good(folder, scale):
        row = campaign.Row("good", "something", "hold")
        row.expect(True, "")
        yield row

    def bad(folder, scale):
        yield from good(folder, scale)
        raise RuntimeError("no such thing")

    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "")
    monkeypatch.setattr(campaign, "PARTS", {"first": good, "bad": bad, "last": good})


def test_a_part_that_crashes_leaves_the_rows_of_all(parts, tmp_path, capsys):
    path = tmp_path / "campaign.md"
    assert campaign.main(["--table", str(path)]) == 1
    said = capsys.readouterr().out
    assert said.count("| part | tried | must | attempts | failed | note |") == 1
    expected = [
        "| first | something | hold | 1 | 0 |  |",
        "| bad | something | hold | 1 | 0 |  |",
        "| bad | the part itself | runs to its end | 1 | 1 |  |",
        "| last | something | hold | 1 | 0 |  |",
    ]
    for text in (said, path.read_text()):
        assert [line for line in text.splitlines() if line in expected] == expected
    assert "RuntimeError: no such thing" in said


def test_a_part_that_runs_alone_prints_its_table_and_keeps_the_others_in_the_file(
    parts, tmp_path, capsys
):
    path = tmp_path / "campaign.md"
    assert campaign.main(["--parts", "first", "--table", str(path)]) == 0
    assert campaign.main(["--parts", "last", "--table", str(path)]) == 0
    said = capsys.readouterr().out
    assert said.count("| first | something") == said.count("| last | something") == 1
    assert path.read_text().count("| something") == 2
