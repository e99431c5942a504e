"""A command line means what its options' annotations say, and is rejected in a sentence of ours."""

from __future__ import annotations

import json
import re

import pytest

from mjx_arm.arguments import read_arguments
from mjx_arm.cli import main
from mjx_arm.cli.parse import annotations_of, parse
from mjx_arm.cli.train import Train
from mjx_arm.config import dump_config, train_config
from mjx_arm.options import flat_names
from mjx_arm.presets import PRESETS


def test_values_are_read_by_their_annotations():
    line = (
        "train --preset pixels --num-envs=8 --size 32 16 --no-double --shadows --gamma 0.5 "
        "--joint-noise None --env B --seed 3 --out some/where --stop-at 0.5 --camera front "
        "--polyak 1e-3"
    )
    command, given = parse(line.split())
    assert isinstance(command, Train)
    options = command.options
    assert (options.num_envs, options.env.size, options.seed) == (8, (32, 16), 3)
    assert (options.algo.double, options.env.shadows, options.algo.gamma) == (False, True, 0.5)
    assert (options.env.joint_noise, options.env.env, options.env.camera) == (None, "B", "front")
    assert (str(command.out), command.stop_at, options.algo.polyak) == ("some/where", 0.5, 1e-3)
    assert options.total_steps == PRESETS["pixels"].total_steps
    assert "num_envs" in given
    assert "double" in given
    assert "replay_size" not in given


def test_several_texts_make_a_tuple():
    assert read_arguments(["--camera", "a", "b"], {"camera": str | tuple[str, ...]}) == (
        {"camera": ("a", "b")},
        [],
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            [],
            "view, sweep, reproduce, transfer, deploy, export; see",
        ),
        (["trian"], "unknown command 'trian': did you mean 'train'?"),
        (["train", "--num-env", "3"], "unknown option '--num-env': did you mean '--num-envs'?"),
        (
            ["train", "--num-envs", "2.5"],
            "--num-envs must be a whole number of at least 1, got '2.5'",
        ),
        (["train", "--num-envs", "many"], "of at least 1, got 'many'"),
        (["train", "--num-envs"], "--num-envs must be a whole number of at least 1, got nothing"),
        (["train", "--num-envs", "0"], "num_envs must be a whole number of at least 1, got 0"),
        (["train", "--num-envs", "9" * 5000], "--num-envs must be a whole number"),
        (["train", "--gamma", "nan"], "gamma must be a finite number above 0 and of at most 1"),
        (["train", "--learning-rate", "inf"], "learning_rate must be a finite number above 0, got"),
        (["train", "--size", "64"], "--size must be a tuple of two values, each a whole number"),
        (["train", "--size", "64", "b"], "of at least 1, got '64 b'"),
        (["train", "--double", "true"], "unexpected argument 'true': options start with --"),
        (["train", "--double=true"], "--double takes no value, got 'true'"),
        (["train", "--storage", "disk"], "--storage must be one of states, pixels, got 'disk'"),
        (["train", "--joint-noise", "x"], "--joint-noise must be a finite number of at least 0"),
        (["train", "--stop-at", "nan"], "stop_at must be a finite number or None, got nan"),
        (["train", "--out"], "--out must be a path or None, got nothing"),
        (["train", "--eval-episodes", "1e3"], "--eval-episodes must be a whole number, got '1e3'"),
        (["train", "--preset", "slow"], "unknown preset 'slow'"),
        (["train", "--config", "nowhere.json"], "nowhere.json cannot be read"),
        (["eval"], "eval needs AGENT, an agent's file or a run folder"),
        (["figures"], "figures needs FOLDER, a run folder"),
        (["eval", "a", "b"], "unexpected argument 'b'"),
        (["eval", "a", "--episodes", "1e3"], "--episodes must be a whole number, got '1e3'"),
        (["eval", "a", "--epsilon", "nan"], "epsilon must be a finite number, got nan"),
        (["play", "a", "--epsilon", "2"], "epsilon must be a finite number from 0 to 1, got 2.0"),
        (["eval", "a", "--max-step", "1"], "unknown option '--max-step': did you mean"),
    ],
)
def test_an_invalid_command_line_is_one_sentence(arguments, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    if arguments[:1] == ["train"] and "--preset" not in arguments and "--config" not in arguments:
        arguments = ["train", "--preset", "pixels", *arguments[1:]]
    assert main(arguments) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.startswith("error: ")
    assert error.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("command", [[], ["train"], ["eval"]])
def test_help_is_help(command, capsys):
    with pytest.raises(SystemExit) as ended:
        main([*command, "--help"])
    assert ended.value.code == 0
    assert "usage: mjx-arm" in capsys.readouterr().out


@pytest.mark.parametrize("preset", ["pixels", "fast"])
def test_the_help_lists_the_options_that_the_command_line_takes(preset, capsys):
    with pytest.raises(SystemExit):
        main(["train", "--preset", preset, "--help"])
    listed = set(re.findall(r"--[a-z][a-z0-9-]*", capsys.readouterr().out))
    names = {*flat_names(PRESETS[preset]), *annotations_of(Train)} - {"options"}
    taken = {f"--{name.replace('_', '-')}" for name in names}
    assert taken <= listed
    assert {x for x in listed - taken if not x.startswith("--no-")} == {"--help"}


def test_another_algorithm_need_only_fit_together_with_the_other_options(tmp_path):
    file = tmp_path / "small.json"
    file.write_text(json.dumps(dump_config(train_config(replay_size=400, batch_size=8))))
    line = f"train --config {file} --algorithm distill --teacher-batch-size 16"
    command, _ = parse([*line.split(), "--student-batch-size", "8"])
    assert isinstance(command, Train)
    assert (command.options.algorithm, command.options.replay.replay_size) == ("distill", 400)
    with pytest.raises(ValueError, match="replay_size must be at least student_batch_size = 500"):
        parse([*line.split(), "--student-batch-size", "500"])
