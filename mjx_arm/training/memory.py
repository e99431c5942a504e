"""What a training run will hold in memory, before it allocates it."""

from __future__ import annotations

import os
import pathlib
from typing import Any

import jax
import numpy as np

from mjx_arm.physics import Physics

# The parts of a run, and the options that make them smaller.
_SETTINGS = {
    "learner": "network, by --hidden or --widths",
    "envs": "--num-envs",
    "obs": "--num-envs or --size",
    "replay": "--replay-size",
    "working": "--num-envs, or batch size",
}
_PARTS = ("learner", "envs", "obs", "replay")
# Control groups say "no limit" by a number close to 2**63.
_NO_LIMIT = 2**60


def memory_plan(state: Any) -> dict[str, int]:
    """Bytes of each part of a `LoopState` on one device, or of its shapes."""
    return {name: tree_size(_on_one_device(getattr(state, name))) for name in _PARTS}


def _on_one_device(tree: Any) -> Any:
    """The shapes of what one device holds of a tree."""

    def part(x: Any) -> jax.ShapeDtypeStruct:
        shape = x.shape if x.sharding is None else x.sharding.shard_shape(x.shape)
        return jax.ShapeDtypeStruct(shape, x.dtype)

    return jax.tree.map(part, tree)


def working_memory(compiled: jax.stages.Compiled, physics: Physics, simulations: int) -> int:
    """Bytes that a compiled program needs beside its arguments and results while it runs.

    Where the device is the host, the memory of a number of simulations in MuJoCo counts too.

    Args:
      compiled: the program.
      physics: what it simulates with.
      simulations: number of simulations side by side.
    """
    host = physics.host_memory(simulations) if jax.default_backend() == "cpu" else 0
    analysis = compiled.memory_analysis()
    return host + (int(analysis.temp_size_in_bytes) if analysis else 0)


def check_memory(plan: dict[str, int], devices: int = 1) -> None:
    """Rejects a plan that cannot fit.

    Args:
      plan: bytes on one device.
      devices: number of local devices that hold as much. On CPU they share the machine's memory.

    Raises:
      ValueError: it needs more than the device, or on CPU the machine or its container, has free;
        names the setting that takes the most.
    """
    if jax.default_backend() == "cpu":
        plan = {name: size * devices for name, size in plan.items()}
    needed, free = sum(plan.values()), free_memory()
    if free is not None and needed > free:
        part = max(plan, key=lambda name: plan[name])
        raise ValueError(
            f"the run needs {needed / 1e9:.2f} GB, of which {part} {plan[part] / 1e9:.2f} GB, and "
            f"{free / 1e9:.2f} GB are free: give a smaller {_SETTINGS[part]}"
        )


def free_memory() -> int | None:
    """Bytes free on the default device, or on CPU in the machine; None where nobody says."""
    device = jax.local_devices()[0]
    if device.platform != "cpu":
        stats = device.memory_stats()
        return stats["bytes_limit"] - stats["bytes_in_use"] if stats else None
    known = [x for x in (_free_of_machine(), free_of_container()) if x is not None]
    return min(known, default=None)


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


def free_of_container(root: pathlib.Path = pathlib.Path("/")) -> int | None:
    """Bytes that the control groups of this process leave it, None without a limit.

    Both versions of control groups are read, each group with all that it is in.

    Args:
      root: of the file system.
    """
    try:
        lines = (root / "proc/self/cgroup").read_text().splitlines()
    except OSError:
        return None
    top, free = root / "sys/fs/cgroup", []
    for line in lines:
        number, controllers, path = line.split(":", 2)
        if number == "0":
            names = ("memory.max", "memory.current", "inactive_file")
            free += [_free_of_group(group, *names) for group in _groups(top, path)]
        elif "memory" in controllers.split(","):
            names = ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")
            free += [_free_of_group(group, *names) for group in _groups(top / "memory", path)]
    return min((x for x in free if x is not None), default=None)


def _groups(top: pathlib.Path, path: str) -> list[pathlib.Path]:
    """A control group and those that it is in. Of its path a container may see only the top."""
    parts = [part for part in path.split("/") if part not in ("", "..")]
    return [top.joinpath(*parts[:count]) for count in range(len(parts) + 1)]


def _free_of_group(group: pathlib.Path, limit: str, used: str, cache: str) -> int | None:
    """Bytes below the limit of one control group; what only caches files counts as free."""
    try:
        most = int((group / limit).read_text())
        taken = int((group / used).read_text())
        stat = dict(line.split() for line in (group / "memory.stat").read_text().splitlines())
    except (OSError, ValueError):  # no such file, or "max"
        return None
    return None if most >= _NO_LIMIT else max(0, most - taken + int(stat.get(cache, 0)))


def tree_size(tree: Any) -> int:
    """Bytes of the arrays of a tree, or of their shapes."""
    total = 0
    for leaf in jax.tree.leaves(tree):
        itemsize = (
            4 if jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.extended) else leaf.dtype.itemsize
        )
        total += int(np.prod(leaf.shape)) * itemsize
    return total
