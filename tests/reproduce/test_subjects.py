"""Which agents the page is about."""

from __future__ import annotations

import pathlib
import shutil

import pytest
from made_runs import make_run

from mjx_arm.reproduce.subjects import find_runs, find_shipped, merge
from mjx_arm.training.agent import find_agent


def add_agent(folder: pathlib.Path) -> None:
    shutil.copy(find_agent(pathlib.Path("agent-b")), folder / "best.safetensors")


def test_runs_are_sorted_by_how_they_were_trained(tmp_path):
    make_run(tmp_path / "one", env="B")
    make_run(tmp_path / "two", env="B", algorithm="distill")
    make_run(tmp_path / "three", env="A", reward="paper")
    make_run(tmp_path / "other", task="reach")
    names = [subject.name for subject in merge(find_runs(tmp_path), [])]
    assert names == ["taught-B-seed0", "pixels-B-seed0", "pixels-paper-A-seed0"]


@pytest.mark.parametrize(
    "options",
    [{"scene": "arm_cube_desk"}, {"randomisation": "tight"}, {"link_mass": (0.9, 1.1)}],
)
def test_an_agent_of_another_world_is_not_on_the_page(tmp_path, options):
    make_run(tmp_path / "plain", env="B")
    make_run(tmp_path / "other", env="B", seed=1, **options)
    assert [subject.name for subject in find_runs(tmp_path)] == ["pixels-B-seed0"]


def test_each_seed_of_a_run_is_an_agent(tmp_path):
    make_run(tmp_path / "run", (90, 80), env="A")
    subjects = find_runs(tmp_path / "run")
    assert [subject.name for subject in subjects] == ["pixels-A-seed0", "pixels-A-seed1"]
    assert subjects[1].run == tmp_path / "run" / "seed-1"
    assert subjects[1].agent is None


def test_shipped_agents_are_there():
    assert {subject.trained_in for subject in find_shipped()} == {"A", "B"}


def test_a_shipped_agent_gets_the_curve_of_a_run_without_an_agent():
    root = pathlib.Path(__file__).parents[2]
    subjects = merge(find_runs(root / "benchmarks" / "results"), find_shipped())
    (agent,) = [x for x in subjects if x.key == ("taught", "B", 0)]
    assert agent.agent == "agent-b"
    assert agent.run.name == "agent-b"


def test_an_agent_of_a_run_takes_the_place_of_the_shipped_one(tmp_path):
    make_run(tmp_path / "run", env="B", algorithm="distill", seed=3)
    add_agent(tmp_path / "run")
    names = [x.name for x in merge(find_runs(tmp_path), find_shipped())]
    assert "taught-B-seed3" in names
    assert "taught-B-seed0" not in names


def test_two_runs_of_one_seed_are_rejected(tmp_path):
    for name in ("one", "two"):
        make_run(tmp_path / name, env="B")
    with pytest.raises(ValueError, match="are both pixels-B-seed0: leave one of them out"):
        merge(find_runs(tmp_path), [])


def test_seeds_with_different_options_are_rejected(tmp_path):
    make_run(tmp_path / "one", env="B")
    make_run(tmp_path / "two", env="B", seed=1, learning_rate=1e-3)
    with pytest.raises(ValueError, match=r"such as learning_rate = 0\.0003 and 0\.001"):
        merge(find_runs(tmp_path), [])


@pytest.mark.parametrize("name", ["nowhere", "empty"])
def test_a_folder_without_runs_is_rejected(tmp_path, name):
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match=f"--runs .*{name} "):
        find_runs(tmp_path / name)
