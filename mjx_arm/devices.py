"""Whether jax can do what training and evaluation ask of it."""

from __future__ import annotations

from typing import Any

import jax


def check_device() -> None:
    """Rejects a jax that has no device, or does not compile.

    Raises:
      ValueError: the device that `JAX_PLATFORMS` names is not there, or `JAX_DISABLE_JIT` is set.
    """
    settings: Any = jax.config
    try:
        jax.devices()
    except (RuntimeError, AssertionError) as error:
        asked = settings.jax_platforms
        what = f"JAX_PLATFORMS={asked}" if asked else "jax"
        raise ValueError(f"{what} finds no device to run on: give one that is here") from error
    if settings.jax_disable_jit:
        raise ValueError("JAX_DISABLE_JIT must be unset: training and evaluation need compilation")
