"""Physics of a scene behind one record of functions, by either of two backends."""

from __future__ import annotations

import copy
import importlib.util

import jax

from mjx_arm.config import BACKENDS
from mjx_arm.physics.base import Physics, PhysicsState
from mjx_arm.scene import Scene, resolve_task

__all__ = ["BACKENDS", "Physics", "PhysicsState", "compiler_options", "make_physics"]

_JAX_VERSION = tuple(int(part) for part in jax.__version__.split(".")[:2])


def make_physics(scene: Scene, backend: str = "auto") -> Physics:
    """Makes the physics of a scene.

    Args:
      scene: a scene of the task; it says how many substeps an iteration has, and how many
        iterations MJX's solver has at most.
      backend: `"native"` (MuJoCo's C++ thread pool; CPU), `"mjx"`, `"mjx-warp"` (needs the extra
        `warp`), or `"auto"`: native where jax runs on CPU, mjx elsewhere.

    Returns:
      The record of functions.

    Raises:
      ValueError: unknown backend, `mjx-warp` without its extra, or a scene that is not the task's.
    """
    if backend not in BACKENDS:
        raise ValueError(f"unknown physics {backend!r}: give one of {', '.join(BACKENDS)}")
    if backend == "auto":
        backend = "native" if jax.default_backend() == "cpu" else "mjx"
    if backend == "mjx-warp" and importlib.util.find_spec("warp") is None:
        raise ValueError(
            "physics 'mjx-warp' needs the extra 'warp': pip install 'mjx-arm[warp]', "
            "or give physics='mjx'"
        )
    ids = resolve_task(scene)
    if backend == "native":
        from mjx_arm.physics.native import make_native

        return make_native(scene.mj_model, ids.substeps)
    # MJX takes seconds to import, and the native backend does without it.
    from mjx_arm.physics.mjx import make_mjx

    mj_model = copy.copy(scene.mj_model)
    mj_model.opt.iterations, mj_model.opt.ls_iterations = ids.mjx_iterations
    return make_mjx(mj_model, ids.substeps, impl="warp" if backend == "mjx-warp" else "jax")


def compiler_options(physics: Physics) -> dict[str, bool]:
    """Options for `jax.jit` of a program that steps this physics.

    On CPU, the fusion emitters of XLA in jax 0.10 make MJX 10 times slower (64 environments on two
    cores: 1,000 substeps/s with them, 12,000 without) and its compilation half as long again. In
    jax 0.11 they do not, and cannot be turned off.
    """
    slow = physics.backend == "mjx" and jax.default_backend() == "cpu"
    return {"xla_cpu_use_fusion_emitters": False} if slow and _JAX_VERSION < (0, 11) else {}
