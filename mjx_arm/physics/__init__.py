"""Physics of a MuJoCo model behind one record of functions, by one of two backends."""

from __future__ import annotations

import copy
import importlib.util
from collections.abc import Sequence

import jax
import mujoco

from mjx_arm.physics.base import (
    BACKENDS,
    FIELDS,
    Physics,
    PhysicsState,
    check_model,
    physics_varies,
    whole_number,
)
from mjx_arm.varies import Varies

__all__ = ["BACKENDS", "FIELDS", "Physics", "PhysicsState", "compiler_options", "make_physics"]

_JAX_VERSION = tuple(int(part) for part in jax.__version__.split(".")[:2])


def make_physics(
    mj_model: mujoco.MjModel,
    backend: str = "auto",
    *,
    substeps: int,
    mjx_iterations: Sequence[int] | None = None,
    varies: Varies | None = None,
) -> Physics:
    """Makes the physics of a model.

    Args:
      mj_model: the model. It is copied, so later changes have no effect.
      backend: `"native"` (MuJoCo's C++ thread pool; CPU), `"mjx"`, `"mjx-warp"` (needs the extra
        `warp`), or `"auto"`: native where jax runs on CPU, mjx elsewhere.
      substeps: number of physics substeps in one iteration, at least 1.
      mjx_iterations: maximum numbers of iterations of MJX's solver and of its line search. By
        default those of the model's options.
      varies: the fields and rows of the model that vary by episode. Physics reads those in
        `FIELDS` and ignores fields of the image alone. Inertias do not follow masses and sizes:
        vary `body_inertia` together with `body_mass`. Contacts of explicit pairs read
        `pair_friction`, not `geom_friction`.

    Returns:
      The record of functions.

    Raises:
      ValueError: an unknown backend, `mjx-warp` without its extra, a count that is not a whole
        number, a model that the backend cannot simulate, or a field that cannot vary.
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
    substeps = whole_number("substeps", substeps)
    check_model(mj_model)
    varies = physics_varies(mj_model, varies)
    mj_model = copy.copy(mj_model)
    if backend == "native":
        from mjx_arm.physics.native import make_native

        return make_native(mj_model, substeps, varies)
    # MJX takes seconds to import, and the native backend does without it.
    from mjx_arm.physics.mjx import make_mjx

    if mjx_iterations is not None:
        if len(mjx_iterations) != 2:
            raise ValueError(f"mjx_iterations must be two numbers, got {mjx_iterations!r}")
        iterations, ls_iterations = (whole_number("mjx_iterations", n) for n in mjx_iterations)
        mj_model.opt.iterations, mj_model.opt.ls_iterations = iterations, ls_iterations
    return make_mjx(mj_model, substeps, varies, impl="warp" if backend == "mjx-warp" else "jax")


def compiler_options(physics: Physics) -> dict[str, bool]:
    """Options for `jax.jit` of a program that steps this physics.

    On CPU with jax 0.10, XLA's fusion emitters make MJX 10 times slower (64 environments on two
    cores: 1,000 substeps/s instead of 12,000) and lengthen its compilation by half. In jax 0.11
    they do not slow MJX down, and cannot be turned off.
    """
    slow = physics.backend == "mjx" and jax.default_backend() == "cpu"
    return {"xla_cpu_use_fusion_emitters": False} if slow and _JAX_VERSION < (0, 11) else {}
