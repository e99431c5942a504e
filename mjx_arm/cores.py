"""How many CPU cores this process may use."""

from __future__ import annotations

import os


def usable_cores() -> int:
    """Cores that the process may run on, as a scheduler, `taskset` or a container's set leaves it.

    Where the system does not say (macOS), all of the machine. XLA counts in the same way.
    """
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
