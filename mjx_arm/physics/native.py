"""Physics by MuJoCo's own C++ thread pool, called from inside a compiled program.

Rows go in, rows come out: a simulation is its float64 integration state, warm start included, that
travels through the scan as uint32 words. The callback keeps nothing between calls, so the function
is pure and its results are bit-identical to a plain `mj_step` loop.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import math
import os
import threading
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import batch as mj_batch

from mjx_arm.kinematics import Poses, make_kinematics
from mjx_arm.physics.base import Physics, PhysicsState
from mjx_arm.physics.float_bits import float32_to_bits, float64_to_words, words_to_float64

_STATE = mujoco.mjtState
# Components that change while a simulation runs; they lead the row, controls follow.
_CARRIED = (
    _STATE.mjSTATE_TIME | _STATE.mjSTATE_QPOS | _STATE.mjSTATE_QVEL | _STATE.mjSTATE_WARMSTART
)
# `step` leaves derived fields a substep behind the state; this stage brings the poses up to it.
_POSITION = mujoco.mjtStage.mjSTAGE_POS
_DERIVED = ("qpos", "qvel", "geom_xpos", "geom_xmat", "site_xpos")


class BatchPool:
    """Batches of one model, lent to one caller at a time.

    A `mujoco.batch.Batch` is not safe for concurrent callers, and the devices of a sharded program
    call back at the same time, each from a thread of its own. A caller takes a free Batch of its
    size, or the pool makes one, so there are never more than there are concurrent callers.
    """

    def __init__(self, mj_model: mujoco.MjModel):
        self._model = mj_model
        self._lock = threading.Lock()
        self._free: dict[int, list[mj_batch.Batch]] = {}

    @contextlib.contextmanager
    def borrow(self, size: int) -> Iterator[mj_batch.Batch]:
        """Lends a Batch of `size` simulations for the length of a `with` block."""
        with self._lock:
            free = self._free.setdefault(size, [])
            batch = free.pop() if free else None
        if batch is None:
            batch = self._make(size)
        try:
            yield batch
        finally:
            with self._lock:
                free.append(batch)

    def _make(self, size: int) -> mj_batch.Batch:
        # Threads beyond one per simulation would only be woken for nothing.
        batch = mj_batch.Batch(self._model, size, nthread=min(size, os.cpu_count() or 1))
        batch.reset(stage=mujoco.mjtStage.mjSTAGE_NONE)
        return batch


class _Silence:
    """Keeps MuJoCo from printing warnings and writing MUJOCO_LOG.TXT; safe to nest and to share."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._depth = 0
        self._saved: mujoco.MjLogConfig | None = None

    def __enter__(self) -> None:
        with self._lock:
            if self._depth == 0:
                self._saved = mujoco.MjLogConfig.get()
                quiet = mujoco.MjLogConfig.get()
                quiet.logto_file = False
                quiet.logto_console = False
                mujoco.MjLogConfig.set(quiet)
            self._depth += 1

    def __exit__(self, *exc_info: object) -> None:
        with self._lock:
            self._depth -= 1
            if self._depth == 0:
                mujoco.MjLogConfig.set(self._saved)


_silence = _Silence()


@dataclasses.dataclass(frozen=True)
class _Layout:
    """Words of a simulation's row, one array each way: every further operand costs 10 us a call.

    In: the carried state, then the controls. Out: the carried state, then what is derived from it.
    """

    model: mujoco.MjModel
    carried: int

    @property
    def derived(self) -> tuple[tuple[int, ...], ...]:
        """Shapes of qpos, qvel, geom_xpos, geom_xmat, site_xpos."""
        model = self.model
        return (
            (model.nq,),
            (model.nv,),
            (model.ngeom, 3),
            (model.ngeom, 3, 3),
            (model.nsite, 3),
        )

    @property
    def out_size(self) -> int:
        return 2 * self.carried + sum(math.prod(shape) for shape in self.derived) + 1

    def split_out(self, row: jax.Array) -> tuple[jax.Array, list[jax.Array], jax.Array]:
        """Carried words, derived float32 arrays, and the diverged flag of one output row."""
        start = 2 * self.carried
        arrays = []
        for shape in self.derived:
            words = row[start : start + math.prod(shape)]
            arrays.append(jax.lax.bitcast_convert_type(words, jnp.float32).reshape(shape))
            start += math.prod(shape)
        return row[: 2 * self.carried], arrays, row[-1] != 0


def make_native(mj_model: mujoco.MjModel, substeps: int) -> Physics:
    """Makes the backend that runs MuJoCo C behind `jax.pure_callback`.

    Args:
      mj_model: the model, without activations, plugins or mocap bodies; it is not copied.
      substeps: physics substeps in one iteration.

    Returns:
      The record of functions.

    Raises:
      ValueError: the model has state that is not carried.
    """
    kinematics = make_kinematics(mj_model)
    carried = mujoco.mj_stateSize(mj_model, int(_CARRIED))
    if carried != _offset(mj_model, _STATE.mjSTATE_CTRL):
        raise ValueError("the native backend supports no activations, history or plugin state")
    layout = _Layout(mj_model, carried)
    step_rows = functools.partial(_step_rows, BatchPool(mj_model), layout, substeps=substeps)
    result = jax.ShapeDtypeStruct((layout.out_size,), jnp.uint32)
    qpos_start = 2 * _offset(mj_model, _STATE.mjSTATE_QPOS)

    def init(qpos: jax.Array, ctrl: jax.Array) -> PhysicsState:
        del ctrl
        words = jnp.zeros((2 * carried,), jnp.uint32)
        words = words.at[qpos_start : qpos_start + 2 * mj_model.nq].set(
            float32_to_bits(qpos).reshape(-1)
        )
        return PhysicsState(
            qpos=qpos,
            qvel=jnp.zeros((mj_model.nv,), jnp.float32),
            poses=kinematics(qpos),
            diverged=jnp.zeros((), jnp.bool_),
            integration=words,
        )

    def step(state: PhysicsState, ctrl: jax.Array) -> PhysicsState:
        ctrl_words = jax.lax.bitcast_convert_type(ctrl, jnp.uint32)
        row = jax.pure_callback(
            step_rows,
            result,
            jnp.concatenate([state.integration, ctrl_words]),
            vmap_method="broadcast_all",
        )
        words, derived, diverged = layout.split_out(row)
        qpos, qvel, *poses = derived
        return PhysicsState(
            qpos=qpos, qvel=qvel, poses=Poses(*poses), diverged=diverged, integration=words
        )

    return Physics("native", init, step, substeps, float(mj_model.opt.timestep))


def _offset(model: mujoco.MjModel, component: mujoco.mjtState) -> int:
    before = int(_STATE.mjSTATE_INTEGRATION) & (int(component) - 1)
    return int(mujoco.mj_stateSize(model, before))


def _step_rows(pool: BatchPool, layout: _Layout, rows: np.ndarray, *, substeps: int) -> np.ndarray:
    """Advances `[..., 2 carried + nu] uint32` rows by an iteration: `[..., out_size] uint32`."""
    rows = np.asarray(rows)
    lead, split = rows.shape[:-1], 2 * layout.carried
    rows = rows.reshape(-1, rows.shape[-1])
    before = words_to_float64(rows[:, :split])
    with pool.borrow(len(rows)) as batch, _silence:
        batch.state[:, : layout.carried] = before
        batch.ctrl[:] = rows[:, split:].view(np.float32)
        failed = _advance(batch, substeps)
        after = batch.state[:, : layout.carried]
        failed |= ~np.isfinite(after).all(axis=-1)
        if failed.any():
            batch.state[failed, : layout.carried] = before[failed]
            batch.forward(np.flatnonzero(failed), stage=_POSITION)
        out = np.empty((len(rows), layout.out_size), np.uint32)
        out[:, :split] = float64_to_words(after)
        derived = out[:, split:-1].view(np.float32)
        start = 0
        for name, shape in zip(_DERIVED, layout.derived, strict=True):
            size = math.prod(shape)
            derived[:, start : start + size] = batch.bind(name).reshape(len(rows), size)
            start += size
        out[:, -1] = failed
    return out.reshape(*lead, layout.out_size)


def _advance(batch: mj_batch.Batch, substeps: int) -> np.ndarray:
    """Steps every simulation and says which of them warned or raised: `[N] bool`."""
    batch.warning[:] = 0
    raised: np.ndarray | list[int] = []
    try:
        batch.step(nstep=substeps, stage=_POSITION)
    except mj_batch.SimulationError as error:
        raised = error.ids
    failed = batch.warning[..., 1].any(axis=-1)
    failed[raised] = True
    return failed
