"""Physics by MuJoCo MJX, on any device that jax runs on."""

from __future__ import annotations

import contextlib
import copy
import io
import os

import jax
import jax.numpy as jnp
import mujoco

# Without the extra `warp`, which the impl "jax" does without, the import prints what it misses.
with contextlib.redirect_stdout(io.StringIO()):
    from mujoco import mjx

from mjx_arm.cores import usable_cores
from mjx_arm.kinematics import make_kinematics
from mjx_arm.physics.base import Physics, PhysicsState

# MuJoCo's own bound (mjMAXVAL) above which it calls a simulation unstable.
_MAX_VALUE = 1e10
# For 17 in 16,384 environments, where rollouts had 10 at most: 80 MB. What is over is dropped.
_WARP_CONTACTS = 17 * 16_384


def _refuse_to_hang(mj_model: mujoco.MjModel) -> None:
    """Refuses a program that XLA's CPU backend may never finish.

    Its batched Cholesky waits, on a thread of the pool, for pieces of itself that are queued to
    the same pool (`ParallelBatchMap` in jaxlib 0.10), so that as many of them at once as there are
    threads wait for ever; 256 environments on two cores did. Each device runs one at a time, or
    two where the integrator factorises a matrix of its own.

    Raises:
      ValueError: there may be as many at once as there are threads.
    """
    if jax.default_backend() != "cpu":
        return
    implicit = mj_model.opt.integrator != mujoco.mjtIntegrator.mjINT_EULER or not (
        mj_model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_EULERDAMP
    )
    at_once = jax.local_device_count() * (2 if implicit else 1)
    threads = int(os.environ.get("NPROC", usable_cores()))
    if 1 < threads <= at_once:
        raise ValueError(
            f"physics 'mjx' can hang on a CPU with {threads} threads and {at_once} matrix "
            f"factorisations at once: start with NPROC={at_once + 1} in the environment, or give "
            "physics='native'"
        )


def make_mjx(mj_model: mujoco.MjModel, substeps: int, impl: str = "jax") -> Physics:
    """Makes the backend that runs MJX.

    Args:
      mj_model: the model.
      substeps: physics substeps in one iteration.
      impl: MJX's implementation, `"jax"` or `"warp"`.

    Returns:
      The record of functions.

    Raises:
      ValueError: on this CPU the program could hang.
    """
    if impl == "jax":
        _refuse_to_hang(mj_model)
    kinematics = make_kinematics(mj_model)
    # MJX never resets by itself, and its "warp" refuses to be told not to.
    told = copy.copy(mj_model)
    told.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    model = mjx.put_model(told, impl=impl)
    # The simulations of a batch share one store of contacts, made before their number is known.
    contacts = {"naconmax": _WARP_CONTACTS} if impl == "warp" else {}
    template = mjx.make_data(told, impl=impl, **contacts)

    def init(qpos: jax.Array, ctrl: jax.Array) -> PhysicsState:
        del ctrl
        at_rest = jnp.zeros((mj_model.nv,), jnp.float32)
        return PhysicsState(
            qpos=qpos,
            qvel=at_rest,
            poses=kinematics(qpos),
            diverged=jnp.zeros((), jnp.bool_),
            integration=at_rest,
        )

    def step(state: PhysicsState, ctrl: jax.Array) -> PhysicsState:
        data = template.replace(
            qpos=state.qpos, qvel=state.qvel, ctrl=ctrl, qacc_warmstart=state.integration
        )
        # MJX mixes dtypes, which a caller's own strictness must not be held against. And it leaves
        # the precision of its products to jax, which would take 10 bits of each number on a GPU.
        with jax.numpy_dtype_promotion("standard"), jax.default_matmul_precision("highest"):
            data = jax.lax.fori_loop(0, substeps, lambda _, d: mjx.step(model, d), data)
        after = (data.qpos, data.qvel, data.qacc_warmstart)
        sane = [jnp.all(jnp.abs(x) < _MAX_VALUE) for x in after]
        diverged = ~(sane[0] & sane[1] & sane[2])
        before = (state.qpos, state.qvel, state.integration)
        qpos, qvel, warmstart = (
            jnp.where(diverged, old, new) for old, new in zip(before, after, strict=True)
        )
        return PhysicsState(
            qpos=qpos,
            qvel=qvel,
            poses=kinematics(qpos),
            diverged=diverged,
            integration=warmstart,
        )

    backend = "mjx" if impl == "jax" else "mjx-warp"
    return Physics(backend, init, step, substeps, float(mj_model.opt.timestep))
