"""The benchmark of two processes, rehearsed."""

from __future__ import annotations

import json
import os
import pathlib
import subprocess
import sys

import jax
import jax.numpy as jnp
import pytest
from jax.sharding import PartitionSpec as P

from mjx_arm.cores import usable_cores
from mjx_arm.shard import Shard

sys.path.insert(0, str(pathlib.Path(__file__).parents[2] / "benchmarks"))
import processes


def test_the_share_of_the_exchange_is_what_a_step_takes_longer():
    rounds = [{"with": 75.0, "without": 100.0}, {"with": 60.0, "without": 100.0}]
    rounds.append({"with": 90.0, "without": 100.0})
    row = processes.summarise("two", rounds)
    assert (row["steps_per_s"], row["least"], row["most"]) == (75, 60, 90)
    assert row["exchange"] == 0.25
    assert processes.summarise("one", [{"with": 50.0}])["exchange"] is None
    assert processes.summarise("two", [{"with": 101.0, "without": 100.0}])["exchange"] == 0


def test_without_the_exchange_no_program_has_a_collective():
    mesh = jax.make_mesh((1,), ("device",))
    shard = Shard("device", 1)

    def text() -> str:
        program = jax.shard_map(
            lambda x: shard.mean(x) + shard.total(x) + shard.largest(x),
            mesh=mesh,
            in_specs=P(),
            out_specs=P(),
            check_vma=False,
        )
        return str(jax.make_jaxpr(program)(jnp.ones(2)))

    with processes.without_exchange():
        assert not any(name in text() for name in ("psum", "pmax"))
    assert all(name in text() for name in ("psum", "pmax"))


def test_all_variants_train_the_same():
    config = processes.config(tiny=False)
    assert config.num_envs % 2 == config.algo.teacher_batch_size % 2 == 0
    assert config.algo.student_batch_size % 2 == 0
    # From the first step on, or no image would be rendered in the loop.
    assert config.algo.student_starts == config.algo.student_warm_up == 0


@pytest.mark.long
@pytest.mark.skipif(usable_cores() < 2, reason="needs two cores")
def test_every_variant_is_rehearsed(tmp_path: pathlib.Path):
    file = tmp_path / "processes.json"
    command = [sys.executable, str(processes.ROOT / "benchmarks" / "processes.py")]
    done = subprocess.run(
        [*command, "--tiny", "--rounds", "1", "--json", str(file)],
        env=os.environ | {"PYTHONPATH": str(processes.ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    content = json.loads(file.read_text())
    assert [row["variant"] for row in content["rows"]] == list(processes.VARIANTS)
    assert all(row["steps_per_s"] > 0 for row in content["rows"])
    assert [row["exchange"] is None for row in content["rows"]] == [True, True, False]
    assert content["machine"]["cores"] >= 2
