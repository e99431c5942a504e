"""A checkpoint is read only as what was written, where it was written."""

from __future__ import annotations

import dataclasses
import errno
import os
import pathlib
import random
import shutil
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_arm.config import dump_config, train_config
from mjx_arm.training.checkpoint import (
    Origin,
    RunCheckpoints,
    config_differences,
    load_tree,
    save_tree,
)
from mjx_arm.training.seal import is_sealed, seal

ORIGIN = Origin("run-1", {"total_steps": 100, "algo": {"gamma": 0.99, "widths": (1, 2)}}, "scene")


def make_tree():
    return {
        "key": jax.random.key(3),
        "words": jnp.arange(1000, dtype=jnp.uint32),
        "flag": jnp.array([True, False]),
        "nothing": jnp.zeros((0, 3), jnp.float32),
        "scalar": jnp.float32(2.5),
    }


def shapes():
    return jax.eval_shape(make_tree)


@pytest.fixture
def run(tmp_path) -> pathlib.Path:
    checkpoints = RunCheckpoints(tmp_path, ORIGIN)
    for step in (10, 20, 30):
        checkpoints.save(step, make_tree())
    return tmp_path


def changed(**values) -> Origin:
    return dataclasses.replace(ORIGIN, **values)


def test_a_tree_comes_back_to_the_bit(run):
    checkpoints = RunCheckpoints(run, ORIGIN)
    assert checkpoints.steps() == [20, 30]
    assert checkpoints.find_newest(shapes()) == 30
    back, tree = checkpoints.load(30, shapes()), make_tree()
    for x, expected in zip(jax.tree.leaves(back), jax.tree.leaves(tree), strict=True):
        assert (x.dtype, x.shape) == (expected.dtype, expected.shape)
    np.testing.assert_array_equal(jax.random.bits(back["key"]), jax.random.bits(tree["key"]))
    np.testing.assert_array_equal(back["words"], tree["words"])


def test_fifty_flipped_bits_are_all_found(run):
    rng, newest = random.Random(0), run / "checkpoints" / f"{30:012d}"
    files = [path for path in sorted(newest.rglob("*")) if path.is_file() and path.stat().st_size]
    manifest = newest / "manifest.json"
    for path in [manifest] * 25 + rng.choices(files, k=25):
        content = path.read_bytes()
        flipped = bytearray(content)
        place = rng.randrange(8 * len(content))
        flipped[place // 8] ^= 1 << place % 8
        path.write_bytes(flipped)
        with pytest.raises(ValueError, match=r"is damaged: .*; remove it to continue from the one"):
            RunCheckpoints(run, ORIGIN).find_newest(shapes())
        path.write_bytes(content)


@pytest.mark.parametrize("name", ["manifest.json", "state"])
def test_a_missing_file_is_found(name, run):
    path = run / "checkpoints" / f"{30:012d}" / name
    found = [path] if path.is_file() else [x for x in sorted(path.rglob("*")) if x.is_file()]
    found[-1].unlink()
    if name == "manifest.json":
        assert RunCheckpoints(run, ORIGIN).find_newest(shapes()) == 20
        return
    with pytest.raises(ValueError, match="is damaged"):
        RunCheckpoints(run, ORIGIN).find_newest(shapes())


def test_the_checkpoint_of_another_step_is_rejected(run):
    folder = run / "checkpoints"
    shutil.rmtree(folder / f"{30:012d}")
    shutil.copytree(folder / f"{20:012d}", folder / f"{30:012d}")
    with pytest.raises(ValueError, match="must be the checkpoint of step 30, got 20; remove it"):
        RunCheckpoints(run, ORIGIN).find_newest(shapes())


@pytest.mark.parametrize(
    ("origin", "message"),
    [
        (changed(run_id="run-2"), "is a checkpoint of another run"),
        (changed(scene="other"), "was made in another scene"),
        (
            changed(config={"total_steps": 100, "algo": {"gamma": 0.9, "widths": [1, 2]}}),
            "was made with other options: gamma was 0.99 and is now 0.9$",
        ),
    ],
)
def test_what_belongs_to_something_else_is_rejected(origin, message, run):
    with pytest.raises(ValueError, match=message):
        RunCheckpoints(run, origin).find_newest(shapes())


def test_the_length_of_a_run_may_change(run):
    longer = changed(config={"total_steps": 900, "algo": {"gamma": 0.99, "widths": (1, 2)}})
    assert RunCheckpoints(run, longer).find_newest(shapes()) == 30
    assert config_differences(ORIGIN.config, longer.config) == ""


def test_other_shapes_are_rejected(run):
    like = shapes() | {"scalar": jax.ShapeDtypeStruct((), jnp.int32)}
    with pytest.raises(ValueError, match="is not a checkpoint of such a run"):
        RunCheckpoints(run, ORIGIN).find_newest(like)


def test_a_full_disk_is_one_sentence_and_keeps_the_ones_before(run, monkeypatch):
    def full(*args, **kwargs):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "posix_fallocate", full)
    for step in (30, 40):
        with pytest.raises(ValueError, match=r"could not be written: No space left on device$"):
            RunCheckpoints(run, ORIGIN).save(step, make_tree())
    monkeypatch.undo()
    assert [path.name for path in sorted((run / "checkpoints").iterdir())] == [
        f"{20:012d}",
        f"{30:012d}",
    ]
    assert RunCheckpoints(run, ORIGIN).find_newest(shapes()) == 30


LIMITED = """
import pathlib, resource, sys
import numpy as np
from mjx_arm.training.checkpoint import save_tree
resource.setrlimit(resource.RLIMIT_FSIZE, (20_000,) * 2)
try:
    save_tree(pathlib.Path(sys.argv[1]), [np.zeros(100), np.zeros(9_000), np.zeros(100)])
except ValueError as error:
    print(error)
    sys.exit(2)
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="limits the size of files")
def test_a_failed_save_prints_no_traceback_and_ends_the_process(tmp_path):
    command = [sys.executable, "-c", LIMITED, str(tmp_path / "tree")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stderr) == (2, "")
    assert "could not be written: " in done.stdout
    assert done.stdout.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_a_tree_without_an_origin_is_no_run_s(tmp_path):
    save_tree(tmp_path / "checkpoints" / f"{5:012d}", make_tree(), step=5)
    load_tree(tmp_path / "checkpoints" / f"{5:012d}", shapes())
    with pytest.raises(ValueError, match="is a checkpoint of another run"):
        RunCheckpoints(tmp_path, ORIGIN).find_newest(shapes())


def test_a_seal_covers_every_character():
    text = seal({"a": [1, 2.5, None], "é": {"b": "\n"}})
    assert is_sealed(text)
    for place in range(len(text) - 1):
        other = "x" if text[place] != "x" else "y"
        assert not is_sealed(text[:place] + other + text[place + 1 :])
    assert not is_sealed("")


def test_an_option_that_is_newer_than_the_run_counts_as_its_default():
    older = dump_config(train_config(algorithm="distill"))
    older["algo"].pop("teacher_double")
    same = dump_config(train_config(algorithm="distill"))
    assert config_differences(older, same) == ""
    other = dump_config(train_config(algorithm="distill", teacher_double=False))
    assert config_differences(older, other) == "teacher_double was True and is now False"


def test_what_a_killed_process_had_begun_is_removed_by_the_next_save(tmp_path):
    checkpoints = RunCheckpoints(tmp_path, ORIGIN)
    begun = checkpoints.folder / "000000000007.part"
    (begun / "state").mkdir(parents=True)
    checkpoints.save(10, make_tree())
    assert [path.name for path in checkpoints.folder.iterdir()] == ["000000000010"]
