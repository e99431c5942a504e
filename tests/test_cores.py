"""A process on a cluster has the cores that its scheduler leaves it, not those of the machine."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

CODE = """
import os
os.environ["JAX_PLATFORMS"] = "cpu"
os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
import jax
jax.block_until_ready(jax.numpy.zeros(3) + 1)
names = [open(f"/proc/self/task/{task}/comm").read() for task in os.listdir("/proc/self/task")]
from mjx_arm.cores import usable_cores
print(usable_cores(), sum(name.startswith("tf_XLAEigen") for name in names))
"""


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="this system does not say")
def test_the_cores_are_those_that_it_may_run_on_as_xla_counts_them():
    done = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["1", "1"]
