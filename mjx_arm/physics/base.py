"""What the two physics backends have in common: the state, and the record of functions."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import flax.struct
import jax

from mjx_arm.kinematics import Poses


@flax.struct.dataclass
class PhysicsState:
    """One simulation at the end of an iteration.

    Attributes:
      qpos: `[nq] float32`, m and rad.
      qvel: `[nv] float32`, m/s and rad/s.
      poses: of geoms and sites at this `qpos`.
      diverged: `[] bool`, the iteration that led here raised a MuJoCo warning or error, or its
        result is not finite; `qpos` and `poses` are then those before it.
      integration: what the backend needs to go on exactly: its own, opaque.
    """

    qpos: jax.Array
    qvel: jax.Array
    poses: Poses
    diverged: jax.Array
    integration: Any


@dataclasses.dataclass(frozen=True)
class Physics:
    """Pure functions over one simulation; jit- and vmap-able, also nested.

    Attributes:
      backend: `"native"`, `"mjx"` or `"mjx-warp"`.
      init: `(qpos [nq] float32, ctrl [nu] float32) -> PhysicsState`, at rest.
      step: `(state, ctrl [nu] float32) -> PhysicsState`, one iteration of `substeps` substeps.
      substeps: physics substeps in one iteration.
      timestep: of one substep, s.
      host_memory: of so many simulations, bytes that the host holds beside their states.
    """

    backend: str
    init: Callable[[jax.Array, jax.Array], PhysicsState]
    step: Callable[[PhysicsState, jax.Array], PhysicsState]
    substeps: int
    timestep: float
    host_memory: Callable[[int], int] = lambda simulations: 0
