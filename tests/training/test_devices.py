"""Several devices of one process; `devices_lab.py` computes what is judged here."""

from __future__ import annotations

import json
import math
import os
import pathlib
import subprocess
import sys

import jax
import pytest

from mjx_arm.config import set_train_options, train_config
from mjx_arm.training.loop import check_takes_shard, make_trainer
from mjx_arm.training.mesh import check_division, make_mesh, shard_of, shards_seeds

LAB = pathlib.Path(__file__).with_name("devices_lab.py")
ROOT = LAB.parents[2]
DEVICES = 4


def four_devices(*checks: str, timeout: float = 600) -> dict:
    """Runs checks of the lab in a process with four CPU devices."""
    flags = f"--xla_force_host_platform_device_count={DEVICES}"
    done = subprocess.run(
        [sys.executable, "-W", "error", str(LAB), *checks],
        # Most of its time is compiling.
        env=os.environ
        | {"XLA_FLAGS": flags, "PYTHONPATH": str(ROOT), "JAX_DISABLE_MOST_OPTIMIZATIONS": "1"},
        capture_output=True,
        text=True,
        timeout=timeout,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-4000:]
    return json.loads(done.stdout)


@pytest.fixture(scope="module")
def lab() -> dict:
    return four_devices("training", "exchange", "samples", "updates")


def test_every_step_of_every_device_is_counted(lab):
    counts = lab["training"]["counts"]
    assert lab["training"]["compiled_again"] == []
    # 20 steps of 8 environments, of which each resets once in 16 steps.
    assert sum(row["steps"] for row in counts) == 8 * (60 - 60 // 16)
    assert sum(row["episodes"] for row in counts) == 8 * (60 // 16)
    assert 0 < counts[0]["updates"] < counts[-1]["updates"] == 20
    assert all(row["diverged"] == 0 for row in counts)


def test_a_tree_is_exchanged_as_one_array_of_each_type(lab):
    found = lab["exchange"]
    # Of rows 0 1, 2 3, 4 5 and 6 7.
    assert found["mean"] == {"a": [[3, 4]], "b": {"c": 30, "d": [[[4], [4], [4]], [[4], [4], [4]]]}}
    assert found["total"] == {"n": 8, "s": [12, 16]}
    assert found["arrays"] == 3  # the mean, and the totals of two types


def test_environments_and_replay_are_spread_and_parameters_are_copied(lab):
    assert lab["training"]["spread"] == ["P('device',)", "P(None, 'device')"]
    assert lab["training"]["copies_agree"]


def test_the_memory_plan_is_that_of_one_device(lab):
    plan, alone = lab["training"]["plan"], lab["training"]["plan_alone"]
    assert plan["learner"] == alone["learner"]
    for part in ("envs", "obs"):
        assert plan[part] * DEVICES == alone[part]
    # The counter of the replay is everywhere.
    assert (plan["replay"] - 4) * DEVICES == alone["replay"] - 4


def test_an_evaluation_does_not_depend_on_the_number_of_devices(lab):
    alone, spread = lab["training"]["evaluations"]
    assert alone == spread
    assert alone["episodes"] == 10


def test_devices_sample_different_batches(lab):
    # The Q-network, the teacher and the student.
    assert len(lab["samples"]["nearest"]) == 3
    assert min(lab["samples"]["nearest"]) > 1e-3


def test_devices_start_different_episodes(lab):
    assert lab["training"]["different_starts"] == 8


def test_updates_from_the_same_samples_agree(lab):
    assert lab["updates"]["learnt"] > 0.01
    assert max(lab["updates"]["gaps"]) < 1e-5


@pytest.mark.slow
def test_a_student_that_sees_pixels_learns_and_acts_on_all_devices():
    found = four_devices("distillation")["distillation"]
    counts = found["counts"]
    # 20 steps of 8 environments, of which each resets once in 16 steps.
    assert sum(row["steps"] for row in counts) == 8 * (80 - 80 // 16)
    assert sum(row["episodes"] for row in counts) == 8 * (80 // 16)
    assert all(row["diverged"] == 0 for row in counts)
    assert 0 < counts[0]["updates"] < 20
    assert [row["updates"] for row in counts[1:]] == [20, 20, 20]
    # Three updates of the student after each step.
    assert [row["student_updates"] for row in counts] == [0, 60, 60, 60]
    assert all(0 < row["student_loss"] < math.inf for row in counts[1:])
    assert found["spread"] == ["P('device',)", "P(None, 'device')"]
    assert found["copies_agree"]
    # Nothing looks at an image before the step from which on the student drives.
    assert found["rendered"] == [False, True, True, True]
    assert found["different_images"] == 8
    assert found["share_of_other_pixels"] < 0.01
    assert found["driven"] == [1, 3, 5, 7]
    assert found["gap"] < 1e-5


@pytest.mark.slow
def test_seeds_are_spread_where_their_number_allows_it():
    found = four_devices("seeds")["seeds"]
    assert found["spread"] == "P('device',)"
    assert len(found["updates"]) == 4
    assert all(found["same_actions"])
    assert max(found["gaps"]) < 1e-4
    assert found["five"] == ["P(None, 'device')", [5, 8]]


@pytest.mark.slow
def test_a_whole_run_is_one_function_under_a_mesh():
    found = four_devices("whole_run")["whole_run"]
    assert found["spread"] == "P('data',)"
    assert found["updates"][-1] == 20
    assert found["seeds"] == [4, 8]
    assert found["gap"] < 1e-5


@pytest.mark.slow
def test_native_physics_on_four_devices_never_hangs():
    found = four_devices("repeats", timeout=1800)["repeats"]
    assert found == {"steps": 200 * 20, "diverged": 0.0}


CONFIG = train_config(observation="state", num_envs=8, batch_size=12)


@pytest.mark.parametrize(
    ("options", "devices", "message"),
    [
        ({}, 3, "num_envs must be a multiple of the number of devices, 3, got 8"),
        ({}, 8, "batch_size must be a multiple of the number of devices, 8, got 12"),
        ({"num_seeds": 2}, 3, "num_envs must be a multiple"),
    ],
)
def test_devices_that_do_not_divide_the_work_are_rejected(options, devices, message):
    with pytest.raises(ValueError, match=message):
        check_division(set_train_options(CONFIG, options), devices)


def test_seeds_are_divided_before_environments():
    assert not shards_seeds(CONFIG, 1)
    assert shards_seeds(set_train_options(CONFIG, {"num_seeds": 6}), 3)
    assert not shards_seeds(set_train_options(CONFIG, {"num_seeds": 6}), 4)
    check_division(set_train_options(CONFIG, {"num_seeds": 6}), 3)


def test_one_device_is_the_program_without_a_mesh():
    assert make_mesh(1) is None
    with pytest.raises(ValueError, match=r"devices must be at most 1.*, got 2"):
        make_mesh(2)


def test_a_mesh_of_two_axes_is_rejected():
    mesh = jax.make_mesh((1, 1), ("a", "b"))
    with pytest.raises(ValueError, match="mesh must have one axis"):
        shard_of(mesh)
    with pytest.raises(ValueError, match="mesh must have one axis"):
        make_trainer(CONFIG, mesh=mesh)


def test_an_own_algorithm_that_averages_nothing_is_rejected():
    check_takes_shard(lambda config, env, *, shard: None, 2)
    with pytest.raises(ValueError, match=r"\(config, env, \*, shard\)"):
        check_takes_shard(lambda config, env: None, 2)
