"""What a training run will hold in memory, before it allocates it."""

from __future__ import annotations

import os
import pathlib
from typing import Any

import jax
import numpy as np

from mjx_arm.physics import Physics

_FIELDS = ("learner", "envs", "obs", "replay")


def memory_plan(state: Any) -> dict[str, int]:
    """Bytes of each part of a `LoopState`, or of its shapes from `jax.eval_shape`."""
    return {name: tree_size(getattr(state, name)) for name in _FIELDS}


def working_memory(compiled: jax.stages.Compiled, physics: Physics, simulations: int) -> int:
    """Bytes that a compiled program needs beside its arguments and results while it runs.

    Those of so many simulations on the host count where that is the device.
    """
    host = physics.host_memory(simulations) if jax.default_backend() == "cpu" else 0
    analysis = compiled.memory_analysis()
    return host + (int(analysis.temp_size_in_bytes) if analysis else 0)


def check_memory(plan: dict[str, int]) -> None:
    """Refuses a plan that cannot fit.

    Raises:
      ValueError: it needs more than the device, or on CPU the machine, has free.
    """
    needed, free = sum(plan.values()), free_memory()
    if free is not None and needed > free:
        raise ValueError(
            f"the run needs {needed / 1e9:.2f} GB, of which the replay {plan['replay'] / 1e9:.2f} "
            f"GB, and {free / 1e9:.2f} GB are free: give a smaller --replay-size or --num-envs"
        )


def free_memory() -> int | None:
    """Bytes free on the default device, or on CPU in the machine; None where nobody says."""
    device = jax.devices()[0]
    if device.platform == "cpu":
        return _free_of_machine()
    stats = device.memory_stats()
    return stats["bytes_limit"] - stats["bytes_in_use"] if stats else None


def _free_of_machine() -> int | None:
    """Bytes that Linux could give without swapping; elsewhere all that there are."""
    meminfo = pathlib.Path("/proc/meminfo")
    if meminfo.is_file():
        lines = meminfo.read_text().splitlines()
        return next(int(x.split()[1]) * 1024 for x in lines if x.startswith("MemAvailable"))
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (ValueError, OSError):
        return None


def tree_size(tree: Any) -> int:
    """Bytes of the arrays of a tree, or of their shapes."""
    total = 0
    for leaf in jax.tree.leaves(tree):
        itemsize = (
            4 if jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.extended) else leaf.dtype.itemsize
        )
        total += int(np.prod(leaf.shape)) * itemsize
    return total
