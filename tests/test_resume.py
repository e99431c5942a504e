"""A run that goes on is the run that never stopped, to the bit."""

from __future__ import annotations

import dataclasses
import os
import pathlib
import random
import shutil
import signal
import subprocess
import sys
import time

import jax
import numpy as np
import pytest

from mjx_arm.agent import load_agent, load_config
from mjx_arm.checkpoint import RunCheckpoints, load_tree, save_tree
from mjx_arm.cli import main
from mjx_arm.config import TrainConfig
from mjx_arm.loop import make_trainer
from mjx_arm.report.metrics import read_metrics

OPTIONS = [
    *("--physics", "native", "--num-envs", "4", "--size", "16", "16", "--replay-size", "400"),
    *("--batch-size", "8", "--learning-starts", "40", "--chunk-steps", "200"),
    *("--max-steps", "25", "--hidden", "16", "--eval-episodes", "4"),
    *("--select-every", "2000", "--select-episodes", "2"),
]
TOTAL_STEPS = 8_000
# Processes that are killed at a random moment each.
KILLS = 10


def final_state(folder: pathlib.Path):
    config = load_config(folder)
    like = jax.eval_shape(make_trainer(config).init, jax.random.key(0))
    state, step = RunCheckpoints(folder).load_newest(like)
    return jax.tree.map(
        lambda x: (
            np.asarray(jax.random.key_data(x))
            if jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key)
            else np.asarray(x)
        ),
        state,
    ), step


def assert_same_run(one: pathlib.Path, other: pathlib.Path) -> None:
    (state, step), (expected, expected_step) = final_state(one), final_state(other)
    assert step == expected_step
    for a, b in zip(jax.tree.leaves(state), jax.tree.leaves(expected), strict=True):
        np.testing.assert_array_equal(a, b)
    rows = [
        [{**row, "steps_per_s": 0, "wall_s": 0} for row in read_metrics(x)] for x in (one, other)
    ]
    assert repr(rows[0]) == repr(rows[1])
    for name in ("last.agent", "best.agent"):
        agents = [load_agent(x / name) for x in (one, other)]
        assert agents[0].env_steps == agents[1].env_steps
        assert agents[0].selection_rate == agents[1].selection_rate
        for a, b in zip(*(jax.tree.leaves(agent.params) for agent in agents), strict=True):
            np.testing.assert_array_equal(a, b)


def command(*arguments: str) -> list[str]:
    return [sys.executable, "-m", "mjx_arm", "train", *arguments]


@pytest.fixture(scope="module")
def whole_run(tmp_path_factory) -> pathlib.Path:
    folder = tmp_path_factory.mktemp("whole") / "run"
    assert main(["train", *OPTIONS, "--total-steps", "4000", "--out", str(folder)]) == 0
    return folder


def test_more_steps_after_the_end_are_those_of_a_longer_run(whole_run, tmp_path):
    folder = tmp_path / "run"
    assert main(["train", *OPTIONS, "--total-steps", "2000", "--out", str(folder)]) == 0
    arguments = ["--resume", str(folder), "--total-steps", "4000", "--eval-episodes", "4"]
    assert main(["train", *arguments]) == 0
    assert_same_run(folder, whole_run)


def test_a_checkpoint_keeps_keys_and_bits(tmp_path):
    tree = {"key": jax.random.key(3), "x": np.arange(3, dtype=np.uint32)}
    save_tree(tmp_path / "tree", tree)
    back = load_tree(tmp_path / "tree", jax.eval_shape(lambda: jax.tree.map(lambda x: x, tree)))
    np.testing.assert_array_equal(jax.random.bits(back["key"]), jax.random.bits(tree["key"]))
    np.testing.assert_array_equal(back["x"], tree["x"])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--seed", "5"], "--seed cannot change"),
        (["--num-envs", "8"], "--num-envs cannot change"),
        (["--env", "B"], "--env cannot change"),
    ],
)
def test_a_changed_option_is_refused_by_name(arguments, message, whole_run, capsys):
    assert main(["train", "--resume", str(whole_run), *arguments]) == 2
    assert message in capsys.readouterr().err


def test_a_damaged_checkpoint_is_named_and_the_one_before_offered(whole_run, tmp_path, capsys):
    folder = tmp_path / "run"
    shutil.copytree(whole_run, folder)
    steps = RunCheckpoints(folder).steps()
    assert len(steps) == 2
    damaged = folder / "checkpoints" / f"{steps[-1]:012d}"
    for path in damaged.rglob("*"):
        if path.is_file() and path.stat().st_size > 1000:
            path.write_bytes(path.read_bytes()[:100])
    assert main(["train", "--resume", str(folder)]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert str(damaged) in error
    assert f"{steps[0]:012d}" in error


def test_what_holds_no_run_is_refused(tmp_path, capsys):
    assert main(["train", "--resume", str(tmp_path)]) == 2
    assert "is no run folder" in capsys.readouterr().err


def test_checkpoints_of_another_network_are_refused(whole_run):
    config = dataclasses.replace(load_config(whole_run), hidden=17)
    like = jax.eval_shape(make_trainer(config).init, jax.random.key(0))
    with pytest.raises(ValueError, match="is not a checkpoint of such a run"):
        RunCheckpoints(whole_run).load(RunCheckpoints(whole_run).steps()[-1], like)


def test_the_default_checkpoint_is_small(tmp_path):
    trainer = make_trainer(TrainConfig(physics="native"))
    save_tree(tmp_path / "state", trainer.init(jax.random.key(0)))
    size = sum(path.stat().st_size for path in tmp_path.rglob("*") if path.is_file())
    assert size <= 300e6


def test_a_full_disk_is_said_and_leaves_nothing_that_counts(tmp_path):
    folder = tmp_path / "run"
    arguments = command(*OPTIONS, "--total-steps", "2000", "--out", str(folder))
    # No file may grow beyond 20 kB: the write fails as on a full disk, with another number.
    limit = "import resource, os, sys; resource.setrlimit(resource.RLIMIT_FSIZE, (20_000,) * 2); "
    limited = [sys.executable, "-c", limit + "os.execv(sys.argv[1], sys.argv[1:])", *arguments]
    done = subprocess.run(limited, capture_output=True, text=True)
    assert done.returncode == 2
    assert "could not be written" in done.stderr
    assert done.stderr.count("\n") == 1
    assert RunCheckpoints(folder).steps() == []
    assert not list(folder.glob("*.agent*"))


@pytest.mark.slow
def test_a_killed_run_goes_on_to_the_same_bits(tmp_path):
    total = ("--total-steps", str(TOTAL_STEPS))
    whole = tmp_path / "whole"
    started = time.monotonic()
    subprocess.run(command(*OPTIONS, *total, "--out", str(whole)), check=True, env=os.environ)
    length = time.monotonic() - started
    folder, moments = tmp_path / "killed", random.Random(0)
    subprocess_command, kills = command(*OPTIONS, *total, "--out", str(folder)), 0
    while kills < KILLS:
        process = subprocess.Popen(subprocess_command)
        try:
            process.wait(timeout=moments.uniform(0.2, 0.9) * length)
            break
        except subprocess.TimeoutExpired:
            process.send_signal(moments.choice([signal.SIGKILL, signal.SIGINT]))
            process.wait()
            kills += 1
        if RunCheckpoints(folder).steps():
            subprocess_command = command("--resume", str(folder), "--eval-episodes", "4")
        else:
            shutil.rmtree(folder, ignore_errors=True)
    if process.returncode != 0:
        subprocess.run(subprocess_command, check=True)
    assert kills > 0
    assert_same_run(folder, whole)
