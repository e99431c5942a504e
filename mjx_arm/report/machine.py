"""What a figure was taken on."""

from __future__ import annotations

import importlib.metadata
import os
import pathlib
import platform
import sys
from typing import Any

import jax
import mujoco

from mjx_arm.cores import usable_cores

_PACKAGES = ("mjx-arm", "jax", "jaxlib", "mujoco", "mujoco-mjx", "flax", "optax", "numpy")


def machine() -> dict[str, Any]:
    """Processor, device and versions."""
    name = platform.processor()
    cpuinfo = pathlib.Path("/proc/cpuinfo")
    if cpuinfo.is_file():
        lines = cpuinfo.read_text().splitlines()
        name = next((x.split(":")[1].strip() for x in lines if x.startswith("model name")), name)
    return {
        "cpu": name,
        "cores": usable_cores(),
        "device": jax.devices()[0].device_kind,
        "python": platform.python_version(),
        # The package is imported by now. Importing it here would be a cycle.
        "mjx_arm": sys.modules["mjx_arm"].__version__,
        "jax": jax.__version__,
        "mujoco": mujoco.__version__,
        "xla_flags": os.environ.get("XLA_FLAGS", ""),
    }


def versions(*more: str) -> dict[str, str | None]:
    """Versions of the packages that figures depend on; None for one that is not installed.

    Args:
      *more: names of further packages.
    """
    return {name: _version(name) for name in (*_PACKAGES, *more)}


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None
