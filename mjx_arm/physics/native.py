"""Physics by MuJoCo's own C++ thread pool, called from inside a compiled program.

Rows go in, rows come out: a simulation is its float64 integration state, warm start included, that
travels through the scan as uint32 words. The callback keeps nothing between calls, so the function
is pure and its results are bit-identical to a plain `mj_step` loop.
"""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import functools
import hashlib
import math
import threading
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import batch as mj_batch

from mjx_arm.cores import usable_cores
from mjx_arm.kinematics import Poses, make_kinematics
from mjx_arm.physics import host_call
from mjx_arm.physics.base import Physics, PhysicsState
from mjx_arm.physics.float_bits import float32_to_bits, float64_to_words

_STATE = mujoco.mjtState
# Components that change while a simulation runs; they lead the row, controls follow.
_CARRIED = (
    _STATE.mjSTATE_TIME | _STATE.mjSTATE_QPOS | _STATE.mjSTATE_QVEL | _STATE.mjSTATE_WARMSTART
)
# `step` leaves derived fields a substep behind the state; this stage brings the poses up to it.
_POSITION = mujoco.mjtStage.mjSTAGE_POS
_POSES = ("geom_xpos", "geom_xmat", "site_xpos")


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
        batch = mj_batch.Batch(self._model, size, nthread=_num_threads(size))
        batch.reset(stage=mujoco.mjtStage.mjSTAGE_NONE)
        # Bound before the first step, since a field is zero until the call after it was bound.
        for name in _POSES:
            batch.bind(name)
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

    In: the carried state in two words a number, then `ctrl` in float32. Out: the carried state,
    then `qpos`, `qvel` and the poses in float32, then whether the simulation diverged.
    """

    carried: int
    qpos: slice
    qvel: slice
    poses: dict[str, tuple[int, ...]]

    @property
    def carried_words(self) -> int:
        return 2 * self.carried

    @property
    def observed(self) -> slice:
        """Of the carried numbers: `qpos` and `qvel`, which are neighbours."""
        return slice(self.qpos.start, self.qvel.stop)

    @property
    def out_size(self) -> int:
        poses = sum(math.prod(shape) for shape in self.poses.values())
        return self.carried_words + (self.qvel.stop - self.qpos.start) + poses + 1

    def split_poses(self, numbers: jax.Array) -> Poses:
        """The poses in what follows `qpos` and `qvel`."""
        arrays, start = {}, 0
        for name, shape in self.poses.items():
            arrays[name] = numbers[start : start + math.prod(shape)].reshape(shape)
            start += math.prod(shape)
        return Poses(**arrays)


def _make_layout(model: mujoco.MjModel) -> _Layout:
    carried = mujoco.mj_stateSize(model, int(_CARRIED))
    if carried != _offset(model, _STATE.mjSTATE_CTRL):
        raise ValueError("the native backend supports no activations, history or plugin state")
    qpos = _offset(model, _STATE.mjSTATE_QPOS)
    qvel = _offset(model, _STATE.mjSTATE_QVEL)
    shapes = (model.ngeom, 3), (model.ngeom, 3, 3), (model.nsite, 3)
    poses = dict(zip(_POSES, shapes, strict=True))
    return _Layout(carried, slice(qpos, qvel), slice(qvel, qvel + model.nv), poses)


def _offset(model: mujoco.MjModel, component: mujoco.mjtState) -> int:
    before = int(_STATE.mjSTATE_INTEGRATION) & (int(component) - 1)
    return int(mujoco.mj_stateSize(model, before))


def make_native(mj_model: mujoco.MjModel, substeps: int) -> Physics:
    """Makes the backend that runs MuJoCo C, called back from the compiled program.

    Args:
      mj_model: the model, without activations, plugins or mocap bodies; it is copied when a batch
        size is seen for the first time.
      substeps: physics substeps in one iteration.

    Returns:
      The record of functions.

    Raises:
      ValueError: the model has state that is not carried.
    """
    kinematics = make_kinematics(mj_model)
    layout = _make_layout(mj_model)
    # A copy: what is registered outlives this call, and may not change with the model.
    pool = BatchPool(copy.copy(mj_model))
    step_rows = functools.partial(_step_rows, pool, layout, substeps=substeps)
    name = _name_of(mj_model, substeps)
    host_call.register(name, step_rows)
    result = jax.ShapeDtypeStruct((layout.out_size,), jnp.uint32)
    nq, nv = mj_model.nq, mj_model.nv

    def init(qpos: jax.Array, ctrl: jax.Array) -> PhysicsState:
        del ctrl
        words = jnp.zeros((layout.carried, 2), jnp.uint32)
        return PhysicsState(
            qpos=qpos,
            qvel=jnp.zeros((nv,), jnp.float32),
            poses=kinematics(qpos),
            diverged=jnp.zeros((), jnp.bool_),
            integration=words.at[layout.qpos].set(float32_to_bits(qpos)).reshape(-1),
        )

    def step(state: PhysicsState, ctrl: jax.Array) -> PhysicsState:
        ctrl_words = jax.lax.bitcast_convert_type(ctrl, jnp.uint32)
        row = _call_host(step_rows, name, result, jnp.concatenate([state.integration, ctrl_words]))
        words, observed, diverged = jnp.split(row, [layout.carried_words, layout.out_size - 1])
        observed = jax.lax.bitcast_convert_type(observed, jnp.float32)
        return PhysicsState(
            qpos=observed[:nq],
            qvel=observed[nq : nq + nv],
            poses=layout.split_poses(observed[nq + nv :]),
            diverged=diverged[0] != 0,
            integration=words,
        )

    def host_memory(simulations: int) -> int:
        data = mujoco.MjData(mj_model)
        # A Batch has one of these for each thread and for itself, and a row for each simulation.
        working = (_num_threads(simulations) + 1) * (data.narena + data.nbuffer)
        poses = sum(math.prod(shape) for shape in layout.poses.values())
        row = mujoco.mj_stateSize(mj_model, int(_STATE.mjSTATE_INTEGRATION)) + poses
        return int(working + 8 * row * simulations)

    timestep = float(mj_model.opt.timestep)
    return Physics("native", init, step, substeps, timestep, host_memory)


def _num_threads(simulations: int) -> int:
    """Threads of a Batch; beyond one per simulation they would only be woken for nothing."""
    return min(simulations, usable_cores())


def _call_host(
    function: host_call.HostFunction, name: str, result: jax.ShapeDtypeStruct, rows: jax.Array
) -> jax.Array:
    """Calls `function(rows, out)`, which fills `out`, with the rows of all environments at once.

    On CPU the function works on XLA's own buffers, and is called by its name. `pure_callback` takes
    65 us there, since it puts its operands on a device again, from inside the running program; and
    every process compiles a program anew that holds one.
    """

    def copied(rows: np.ndarray) -> np.ndarray:
        out = np.empty((*np.shape(rows)[:-1], *result.shape), result.dtype)
        function(np.asarray(rows), out)
        return out

    returned = jax.lax.platform_dependent(
        rows,
        cpu=lambda rows: host_call.call(name, rows, result),
        default=lambda rows: jax.pure_callback(copied, result, rows, vmap_method="broadcast_all"),
    )
    # A callback forgets over which axes of a mesh its operands vary, which `shard_map` checks.
    return returned | (rows[0] & jnp.uint32(0))


def _name_of(mj_model: mujoco.MjModel, substeps: int) -> str:
    """What this model's steps are called in compiled programs, in every process."""
    buffer = np.empty(mujoco.mj_sizeModel(mj_model), np.uint8)
    mujoco.mj_saveModel(mj_model, None, buffer)
    digest = hashlib.sha256(buffer.tobytes()).hexdigest()
    return f"mjx_arm_step_{substeps}_{digest[:32]}"


def _step_rows(
    pool: BatchPool, layout: _Layout, rows: np.ndarray, out: np.ndarray, *, substeps: int
) -> None:
    """Advances `rows [..., 2 carried + nu]` by an iteration into `out [..., out_size]`."""
    rows, out = rows.reshape(-1, rows.shape[-1]), out.reshape(-1, layout.out_size)
    split = layout.carried_words
    with pool.borrow(len(rows)) as batch, _silence:
        carried = batch.state[:, : layout.carried]
        words = float64_to_words(carried)
        words[:] = rows[:, :split]
        batch.ctrl[:] = rows[:, split:].view(np.float32)
        failed = _advance(batch, substeps)
        # The sum is finite where every term is, but for terms that no simulation survives.
        failed |= ~np.isfinite(carried.sum(axis=-1))
        if failed.any():
            words[failed] = rows[failed, :split]
        out[:, :split] = words
        numbers = out[:, split:-1].view(np.float32)
        start = layout.observed.stop - layout.observed.start
        numbers[:, :start] = carried[:, layout.observed]
        for name, shape in layout.poses.items():
            size = math.prod(shape)
            numbers[:, start : start + size] = batch.bind(name).reshape(len(rows), size)
            start += size
        for row in np.flatnonzero(failed):
            poses = _poses_before(batch.model, layout, carried[row])
            numbers[row, -len(poses) :] = poses
    out[:, -1] = failed


def _poses_before(model: mujoco.MjModel, layout: _Layout, carried: np.ndarray) -> np.ndarray:
    """The poses of a state that could not be stepped; kinematics cannot fail again."""
    data = mujoco.MjData(model)
    data.qpos[:] = carried[layout.qpos]
    mujoco.mj_kinematics(model, data)
    return np.concatenate([getattr(data, name).ravel() for name in layout.poses])


def _advance(batch: mj_batch.Batch, substeps: int) -> np.ndarray:
    """Steps every simulation and says which of them warned or raised: `[N] bool`."""
    warnings = batch.warning
    warnings[:] = 0
    raised: np.ndarray | list[int] = []
    try:
        batch.step(nstep=substeps, stage=_POSITION)
    except mj_batch.SimulationError as error:
        raised = error.ids
    failed = warnings[..., 1].any(axis=-1)
    failed[raised] = True
    return failed
