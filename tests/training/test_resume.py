"""A run that is resumed equals the run that never stopped, to the bit."""

from __future__ import annotations

import os
import pathlib
import random
import re
import shutil
import signal
import subprocess
import sys
import time

import jax
import numpy as np
import pytest
from made_runs import make_run
from quick_run import REPLACED

from mjx_arm.cli import main
from mjx_arm.config import set_train_options
from mjx_arm.presets import PRESETS
from mjx_arm.report.metrics import read_metrics
from mjx_arm.training.agent import load_agent
from mjx_arm.training.checkpoint import (
    RunCheckpoints,
    load_tree,
    save_tree,
    write_manifest,
)
from mjx_arm.training.loop import make_trainer, run_keys
from mjx_arm.training.memory import tree_size
from mjx_arm.training.run_folder import load_config, load_run, save_run

OPTIONS = [
    # State features compile in a fraction of the time; the runs that are killed learn from pixels.
    *("--preset", "pixels"),
    *("--observation", "state"),
    *("--physics", "native", "--num-envs", "4", "--size", "16", "16", "--replay-size", "400"),
    *("--batch-size", "8", "--learning-starts", "40", "--chunk-steps", "200"),
    *("--max-steps", "25", "--hidden", "16", "--eval-episodes", "4"),
    *("--select-every", "2000", "--select-episodes", "2", "--no-video"),
]
TOTAL_STEPS = 8_000
# Processes that are killed at a random moment each.
KILLS = 4


def final_state(folder: pathlib.Path):
    config = load_config(folder)
    like = jax.eval_shape(make_trainer(config).init, run_keys(config))
    checkpoints = RunCheckpoints(folder)
    step = checkpoints.find_newest(like)
    state = checkpoints.load(step, like)
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
    for name in ("last.safetensors", "best.safetensors"):
        agents = [load_agent(x / name) for x in (one, other)]
        assert agents[0].env_steps == agents[1].env_steps
        assert agents[0].selection_rate == agents[1].selection_rate
        for a, b in zip(*(jax.tree.leaves(agent.params) for agent in agents), strict=True):
            np.testing.assert_array_equal(a, b)


def assert_rejected_and_untouched(folder: pathlib.Path, message: str, capsys) -> None:
    before = (folder / "metrics.jsonl").read_text()
    assert main(["train", "--resume", str(folder)]) == 2
    assert message in capsys.readouterr().err
    assert (folder / "metrics.jsonl").read_text() == before


def command(*arguments: str) -> list[str]:
    return [sys.executable, "-m", "mjx_arm", "train", *arguments]


def train(*arguments: str) -> None:
    """A run without its last evaluation and its pictures."""
    with pytest.MonkeyPatch.context() as patch:
        for module, name, function in REPLACED:
            patch.setattr(module, name, function)
        assert main(["train", *arguments]) == 0


@pytest.fixture(scope="module")
def whole_run(tmp_path_factory) -> pathlib.Path:
    folder = tmp_path_factory.mktemp("whole") / "run"
    train(*OPTIONS, "--total-steps", "4000", "--out", str(folder))
    return folder


def test_more_steps_after_the_end_are_those_of_a_longer_run(whole_run, tmp_path):
    folder = tmp_path / "run"
    train(*OPTIONS, "--total-steps", "2000", "--out", str(folder))
    train("--resume", str(folder), "--total-steps", "4000", "--eval-episodes", "4", "--no-video")
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
def test_a_changed_option_is_rejected_by_name(arguments, message, whole_run, capsys):
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


@pytest.mark.parametrize("damage", ["same size", "no manifest", "foreign manifest"])
def test_damage_of_any_kind_is_found(damage, whole_run, tmp_path, capsys):
    folder = tmp_path / "run"
    shutil.copytree(whole_run, folder)
    newest = folder / "checkpoints" / RunCheckpoints(folder).newest()
    if damage == "same size":
        path = max((x for x in newest.rglob("*") if x.is_file()), key=lambda x: x.stat().st_size)
        content = bytearray(path.read_bytes())
        content[len(content) // 2] ^= 1
        path.write_bytes(content)
    else:
        (newest / "manifest.json").write_text("" if damage == "no manifest" else "[1]")
    assert main(["train", "--resume", str(folder)]) == 2
    error = capsys.readouterr().err
    assert f"{newest} is damaged" in error
    assert error.count("\n") == 1


@pytest.mark.slow
def test_a_run_that_has_saved_nothing_yet_begins_again(whole_run, tmp_path):
    folder = tmp_path / "run"
    folder.mkdir()
    save_run(folder, load_run(whole_run))
    # Nine chunks of 200 steps, and half of the line of the tenth: there is nothing else yet.
    lines = (whole_run / "metrics.jsonl").read_text().splitlines(keepends=True)
    (folder / "metrics.jsonl").write_text("".join(lines[:9]) + lines[9][:20])
    train("--resume", str(folder), "--eval-episodes", "4", "--no-video")
    assert_same_run(folder, whole_run)


@pytest.mark.parametrize("chunks", [20, 2], ids=["a whole run", "one that ended early"])
def test_a_run_whose_checkpoints_are_gone_does_not_begin_again(chunks, whole_run, tmp_path, capsys):
    folder = tmp_path / "run"
    shutil.copytree(whole_run, folder)
    shutil.rmtree(folder / "checkpoints")
    lines = (folder / "metrics.jsonl").read_text().splitlines(keepends=True)
    assert len(lines) == 20
    # Before its first checkpoint a run begins again; one that has left agents does not.
    (folder / "metrics.jsonl").write_text("".join(lines[:chunks]))
    assert_rejected_and_untouched(folder, "holds no checkpoint to continue from", capsys)


def test_one_seed_of_several_is_not_resumed_alone(tmp_path, capsys):
    folder = tmp_path / "run"
    make_run(folder, successes=(90, 91))
    message = f"is one seed of several: give the folder of all, {folder}"
    assert_rejected_and_untouched(folder / "seed-0", message, capsys)


def test_a_checkpoint_of_another_device_is_read(tmp_path):
    """Orbax would look for the device that it was written from."""
    path = tmp_path / "tree"
    save_tree(path, {"x": jax.numpy.arange(3.0)})
    layout = path / "state" / "_sharding"
    elsewhere, names = re.subn(r"\w+:0", "elsewhere:7", layout.read_text())
    assert names == 1
    layout.write_text(elsewhere)
    write_manifest(path, {"x": jax.numpy.arange(3.0)})
    like = {"x": jax.ShapeDtypeStruct((3,), jax.numpy.float32)}
    np.testing.assert_array_equal(load_tree(path, like)["x"], np.arange(3.0))


def test_fewer_steps_than_are_done_are_rejected(whole_run, capsys):
    before = load_config(whole_run)
    assert main(["train", "--resume", str(whole_run), "--total-steps", "400"]) == 2
    assert "--total-steps must be at least 4000, which the run has made" in capsys.readouterr().err
    assert load_config(whole_run) == before


def test_what_holds_no_run_is_rejected(tmp_path, capsys):
    assert main(["train", "--resume", str(tmp_path)]) == 2
    assert "is not a run folder" in capsys.readouterr().err


def test_checkpoints_of_another_network_are_rejected(whole_run):
    config = set_train_options(load_config(whole_run), {"hidden": 17})
    like = jax.eval_shape(make_trainer(config).init, jax.random.key(0))
    with pytest.raises(ValueError, match="is not a checkpoint of such a run"):
        RunCheckpoints(whole_run).load(RunCheckpoints(whole_run).steps()[-1], like)


def test_checkpoints_are_small_however_full_the_replay():
    sizes = {}
    for name in ("fast", "pixels", "smoke", "paper"):
        state = jax.eval_shape(make_trainer(PRESETS[name]).init, jax.random.key(0))
        # Before compression, which does little for a full replay.
        assert tree_size(state) <= 300e6
        sizes[name] = tree_size(state.replay)
    assert PRESETS["paper"].replay.replay_size == 500_000
    assert sizes["paper"] <= 100e6


def test_a_full_disk_is_said_and_leaves_nothing_that_counts(tmp_path):
    folder = tmp_path / "run"
    options = [*OPTIONS, "--observation", "packed"]
    arguments = command(*options, "--total-steps", "2000", "--out", str(folder))
    # No file may grow beyond 20 kB: the write fails as on a full disk, with another number.
    limit = "import resource, os, sys; resource.setrlimit(resource.RLIMIT_FSIZE, (20_000,) * 2); "
    limited = [sys.executable, "-c", limit + "os.execv(sys.argv[1], sys.argv[1:])", *arguments]
    done = subprocess.run(limited, capture_output=True, text=True)
    assert done.returncode == 2
    assert "could not be written" in done.stderr
    assert done.stderr.count("\n") == 1
    assert RunCheckpoints(folder).steps() == []
    assert not list(folder.glob("*.safetensors*"))


LATER = """
import pathlib, resource, sys, threading, time

def watch():
    while not list(pathlib.Path(sys.argv[1]).glob("checkpoints/*/manifest.json")):
        time.sleep(0.01)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000,) * 2)

threading.Thread(target=watch, daemon=True).start()
from mjx_arm.cli import main
sys.exit(main(sys.argv[2:]))
"""


@pytest.mark.slow
def test_a_disk_that_fills_up_leaves_the_last_whole_checkpoint(tmp_path):
    folder = tmp_path / "run"
    # A file of the checkpoint is larger than what then fits, an agent smaller.
    options = ["train", *OPTIONS, "--total-steps", "4000", "--replay-size", "20000"]
    options += ["--observation", "packed", "--storage", "pixels"]
    started = [sys.executable, "-c", LATER, str(folder), *options, "--out", str(folder)]
    done = subprocess.run(started, capture_output=True, text=True)
    assert done.returncode == 2
    newest = RunCheckpoints(folder).newest()
    assert newest == f"{500:012d}"
    assert f"checkpoints/{1000:012d} could not be written" in done.stderr
    assert f"--resume continues from {newest}" in done.stderr
    assert done.stderr.count("\n") == 1
    assert not list(folder.glob("checkpoints/*tmp*"))
    # Room again.
    assert main(["train", "--resume", str(folder), "--eval-episodes", "4", "--no-video"]) == 0
    assert load_agent(folder / "last.safetensors").env_steps == 4000


@pytest.mark.slow
def test_a_killed_run_continues_to_the_same_bits(tmp_path):
    total = ("--total-steps", str(TOTAL_STEPS), "--observation", "packed")
    whole = tmp_path / "whole"
    started = time.monotonic()
    subprocess.run(command(*OPTIONS, *total, "--out", str(whole)), check=True, env=os.environ)
    length = time.monotonic() - started
    moments, kills, runs = random.Random(0), 0, 0
    while kills < KILLS:
        folder = tmp_path / f"killed-{runs}"
        kills += run_with_kills([*total, "--out", str(folder)], folder, moments, length)
        assert_same_run(folder, whole)
        runs += 1


def run_with_kills(
    options: list[str], folder: pathlib.Path, moments: random.Random, length: float
) -> int:
    """Runs to the end through kills at random moments, and counts those."""
    first, kills = command(*OPTIONS, *options), 0
    again = command("--resume", str(folder), "--eval-episodes", "4", "--no-video")
    while True:
        # Killed before there is a configuration, a run is started as if it never was.
        begun = (folder / "config.json").is_file()
        process = subprocess.Popen(again if begun else first)
        try:
            process.wait(timeout=moments.uniform(0.2, 0.9) * length)
        except subprocess.TimeoutExpired:
            process.send_signal(moments.choice([signal.SIGKILL, signal.SIGINT]))
            process.wait()
            kills += 1
        assert process.returncode in (0, 130, -signal.SIGKILL)
        if process.returncode == 0:
            return kills
