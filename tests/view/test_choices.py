"""What there is to watch: the agents of a run, shipped ones, and scenes."""

from __future__ import annotations

import pathlib
import shutil

import pytest
from made_runs import make_run

from mjx_arm.cli import main
from mjx_arm.training.agent import find_agent
from mjx_arm.view.choices import Choice, find_choices, is_scene, training_line

AGENT = find_agent(pathlib.Path("agent-b"))


def test_a_shipped_agent_comes_first_and_once():
    names = [choice.name for choice in find_choices(pathlib.Path("agent-b"))]
    assert names[0] == "agent-b"
    assert names.count("agent-b") == 1


def test_the_agents_of_a_run_come_before_the_shipped_ones(tmp_path):
    folder = tmp_path / "run"
    make_run(folder, (1, 2))
    for name in ("seed-0/last", "seed-1/best", "seed-1/last"):
        shutil.copy(AGENT, folder / f"{name}.safetensors")
    names = [choice.name for choice in find_choices(folder)]
    assert names[:3] == ["seed-0/last", "seed-1/best", "seed-1/last"]
    assert "agent-b" in names[3:]


def test_where_a_training_stands_is_said(tmp_path):
    folder = tmp_path / "run"
    make_run(folder)
    choice = Choice("last", folder / "last.safetensors")
    assert training_line(choice) == "training: 60,000 steps, success 50 %"
    assert training_line(Choice("agent-b", AGENT)) == ""


def test_a_choice_changes_when_its_file_is_written_again(tmp_path):
    choice = Choice("last", tmp_path / "last.safetensors")
    assert choice.version == 0
    choice.path.touch()
    assert choice.version > 0


def test_scenes_and_agents_are_told_apart():
    assert is_scene(pathlib.Path("arm_push"))
    assert not is_scene(pathlib.Path("agent-b"))
    assert not is_scene(AGENT)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "view needs SUBJECT, an agent, a run folder or a scene"),
        (["nothing"], "nothing is not a run folder and not an agent"),
        (["nothing"], "or a scene: arm_cube, arm_cube_desk, arm_push, arm_reach"),
        (["run"], "run holds no agent: the run has not saved one yet"),
        (["agent-b", "--task", "push"], "--task is for a scene; an agent brings its own"),
        (["arm_cube", "--task", "push"], "scene 'arm_cube' has no"),
        (["agent-b", "--epsilon", "2"], "epsilon must be a finite number from 0 to 1, got 2.0"),
        (["agent-b", "--port", "0"], "port must be from 1 to 65535, got 0"),
        (["agent-b", "--seed", "-1"], "seed must be from 0 to 2147483647, got -1"),
    ],
)
def test_bad_input_gets_one_sentence(arguments, message, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    make_run(tmp_path / "run")
    assert main(["view", *arguments]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_a_missing_extra_is_named(capsys, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "viser", None)
    assert main(["view", "agent-b"]) == 2
    assert capsys.readouterr().err == (
        "error: the viewer needs the extra 'view': pip install 'mjx-arm[view]'\n"
    )
