"""Physics by MuJoCo's own C++ thread pool, called from inside a compiled program.

Each simulation is one row of uint32 words that travels through the scan: its float64 integration
state with activations and warm start, its controls, and its params if any vary. Results depend on
the row alone and are bit-identical to a plain `mj_step` loop.
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
from mjx_arm.digest import model_digest
from mjx_arm.kinematics import Poses, make_kinematics
from mjx_arm.physics import host_call
from mjx_arm.physics.base import (
    DERIVING_FIELDS,
    NO_PARAMS,
    NO_VARIES,
    Physics,
    PhysicsState,
    param_shapes,
    select_params,
    settled_activations,
)
from mjx_arm.physics.float_bits import float32_to_bits, float64_to_words
from mjx_arm.silence import mujoco_silence
from mjx_arm.varies import Params, Varies

_STATE = mujoco.mjtState
# Components that change while a simulation runs. They lead the row; controls follow.
_CARRIED = (
    _STATE.mjSTATE_TIME
    | _STATE.mjSTATE_QPOS
    | _STATE.mjSTATE_QVEL
    | _STATE.mjSTATE_ACT
    | _STATE.mjSTATE_WARMSTART
)
# `step` leaves derived fields a substep behind the state; this stage brings the poses up to it.
_POSITION = mujoco.mjtStage.mjSTAGE_POS
_POSES = ("geom_xpos", "geom_xmat", "site_xpos")
_NONE = np.zeros(0, np.int64)
# What `mj_setConst` writes, which a Batch then holds once for each simulation.
_DERIVED = (
    "actuator_acc0",
    "actuator_length0",
    "body_invweight0",
    "body_subtreemass",
    "bvh_aabb",
    "cam_mat0",
    "cam_pos0",
    "cam_poscom0",
    "dof_M0",
    "dof_invweight0",
    "dof_length",
    "geom_aabb",
    "geom_rbound",
    "light_dir0",
    "light_pos0",
    "light_poscom0",
    "tendon_invweight0",
    "tendon_length0",
)


class BatchPool:
    """Batches of one model, lent to one caller at a time.

    A `mujoco.batch.Batch` is not safe for concurrent callers, and the devices of a sharded program
    call back at the same time, each from its own thread. A caller takes a free Batch of its size,
    or the pool makes one, so there are never more Batches than concurrent callers.
    """

    def __init__(self, mj_model: mujoco.MjModel, varies: Varies = NO_VARIES):
        self._model = mj_model
        self._varies = varies
        self._lock = threading.Lock()
        self._free: dict[int, list[mj_batch.Batch]] = {}

    @contextlib.contextmanager
    def borrow(self, size: int) -> Iterator[mj_batch.Batch]:
        """Lends a Batch of `size` simulations for the duration of a `with` block."""
        with self._lock:
            free = self._free.setdefault(size, [])
            batch = free.pop() if free else None
        if batch is None:
            batch = self.make(size)
        try:
            yield batch
        finally:
            with self._lock:
                free.append(batch)

    def make(self, size: int) -> mj_batch.Batch:
        """Makes a Batch that the pool does not hold."""
        batch = mj_batch.Batch(self._model, size, nthread=_num_threads(size))
        batch.reset(stage=mujoco.mjtStage.mjSTAGE_NONE)
        # Bound before the first step: a field is zero until the first call after it was bound.
        for name in _POSES:
            batch.bind(name)
        for name in self._varies:
            batch.expand(name)
        # From here on derived constants always come from `set_const`, also where the params are
        # still the model's own values.
        if DERIVING_FIELDS.intersection(self._varies):
            batch.set_const()
        return batch


@dataclasses.dataclass(frozen=True)
class _Param:
    """Where one field of the params is in a row, and where it goes in the model.

    Attributes:
      field: its name in MjModel.
      ids: `[n] int`, its rows that vary.
      words: the words of the row that hold it.
      shape: `(n, ...)`.
    """

    field: str
    ids: np.ndarray
    words: slice
    shape: tuple[int, ...]


@dataclasses.dataclass(frozen=True)
class _Layout:
    """Words of a simulation's row, one array each way: every further operand costs 10 us a call.

    In: the carried state (two words a number), `ctrl` and the params (float32). Out: the carried
    state, then `qpos`, `qvel` and the poses in float32, then whether the simulation diverged.
    """

    carried: int
    qpos: slice
    qvel: slice
    act: slice
    poses: dict[str, tuple[int, ...]]
    params: tuple[_Param, ...]

    @property
    def carried_words(self) -> int:
        return 2 * self.carried

    @property
    def observed(self) -> slice:
        """The carried numbers `qpos` and `qvel`, which are neighbours."""
        return slice(self.qpos.start, self.qvel.stop)

    @property
    def out_size(self) -> int:
        poses = sum(math.prod(shape) for shape in self.poses.values())
        return self.carried_words + (self.qvel.stop - self.qpos.start) + poses + 1

    def split_poses(self, numbers: jax.Array) -> Poses:
        """The poses in the numbers that follow `qpos` and `qvel`."""
        arrays, start = {}, 0
        for name, shape in self.poses.items():
            arrays[name] = numbers[start : start + math.prod(shape)].reshape(shape)
            start += math.prod(shape)
        return Poses(**arrays)


def _make_layout(model: mujoco.MjModel, varies: Varies) -> _Layout:
    carried = mujoco.mj_stateSize(model, int(_CARRIED))
    qpos, qvel, act = (
        _offset(model, component)
        for component in (_STATE.mjSTATE_QPOS, _STATE.mjSTATE_QVEL, _STATE.mjSTATE_ACT)
    )
    shapes = (model.ngeom, 3), (model.ngeom, 3, 3), (model.nsite, 3)
    params, start = [], 2 * carried + model.nu
    for field, shape in param_shapes(model, varies).items():
        words = slice(start, start + math.prod(shape))
        params.append(_Param(field, np.asarray(varies[field]), words, shape))
        start = words.stop
    return _Layout(
        carried=carried,
        qpos=slice(qpos, qpos + model.nq),
        qvel=slice(qvel, qvel + model.nv),
        act=slice(act, act + model.na),
        poses=dict(zip(_POSES, shapes, strict=True)),
        params=tuple(params),
    )


def _offset(model: mujoco.MjModel, component: mujoco.mjtState) -> int:
    before = int(_STATE.mjSTATE_INTEGRATION) & (int(component) - 1)
    return int(mujoco.mj_stateSize(model, before))


def make_native(mj_model: mujoco.MjModel, substeps: int, varies: Varies = NO_VARIES) -> Physics:
    """Makes the backend that runs MuJoCo C, called back from the compiled program.

    Args:
      mj_model: the model, checked by `check_model`.
      substeps: number of physics substeps in one iteration.
      varies: the fields and rows that params give, from `physics_varies`.

    Returns:
      The record of functions.

    Raises:
      ValueError: MuJoCo cannot run the model in a batch.
    """
    kinematics = make_kinematics(mj_model, varies)
    layout = _make_layout(mj_model, varies)
    shapes = param_shapes(mj_model, varies)
    # A copy: what is registered outlives this call, and may not change with the model.
    pool = BatchPool(copy.copy(mj_model), varies)
    _try(pool)
    step_rows = functools.partial(_step_rows, pool, layout, substeps=substeps)
    name = _name_of(mj_model, substeps, varies)
    host_call.register(name, step_rows)
    result = jax.ShapeDtypeStruct((layout.out_size,), jnp.uint32)
    nq, nv = mj_model.nq, mj_model.nv

    def init(qpos: jax.Array, ctrl: jax.Array, params: Params = NO_PARAMS) -> PhysicsState:
        words = jnp.zeros((layout.carried, 2), jnp.uint32)
        words = words.at[layout.qpos].set(float32_to_bits(qpos))
        if mj_model.na:
            act = settled_activations(mj_model, ctrl)
            words = words.at[layout.act].set(float32_to_bits(act))
        return PhysicsState(
            qpos=qpos,
            qvel=jnp.zeros((nv,), jnp.float32),
            poses=kinematics(qpos, select_params(shapes, params)),
            diverged=jnp.zeros((), jnp.bool_),
            integration=words.reshape(-1),
        )

    def step(state: PhysicsState, ctrl: jax.Array, params: Params = NO_PARAMS) -> PhysicsState:
        inputs = [ctrl, *(x.reshape(-1) for x in select_params(shapes, params).values())]
        words = [jax.lax.bitcast_convert_type(x, jnp.uint32) for x in inputs]
        row = jnp.concatenate([state.integration, *words])
        row = host_call.call(name, step_rows, row, result)
        carried, observed, diverged = jnp.split(row, [layout.carried_words, layout.out_size - 1])
        observed = jax.lax.bitcast_convert_type(observed, jnp.float32)
        return PhysicsState(
            qpos=observed[:nq],
            qvel=observed[nq : nq + nv],
            poses=layout.split_poses(observed[nq + nv :]),
            diverged=diverged[0] != 0,
            integration=carried,
        )

    def host_memory(simulations: int) -> int:
        data = mujoco.MjData(mj_model)
        # A Batch has one of these for each thread and for itself, and a row for each simulation.
        working = (_num_threads(simulations) + 1) * (data.narena + data.nbuffer)
        poses = sum(math.prod(shape) for shape in layout.poses.values())
        row = mujoco.mj_stateSize(mj_model, int(_STATE.mjSTATE_INTEGRATION)) + poses
        row += sum(getattr(mj_model, field).size for field in _expanded(varies))
        return int(working + 8 * row * simulations)

    timestep = float(mj_model.opt.timestep)
    return Physics("native", init, step, substeps, timestep, host_memory, varies)


def _try(pool: BatchPool) -> None:
    """Makes a Batch of one simulation.

    Raises:
      ValueError: MuJoCo cannot run the model in a batch.
    """
    try:
        pool.make(1)
    except (ValueError, RuntimeError, mujoco.FatalError) as error:
        reason = " ".join(str(error).split())
        raise ValueError(f"physics 'native' cannot run this model: {reason}") from error


def _expanded(varies: Varies) -> set[str]:
    """Names of the fields that a Batch holds once for each simulation."""
    derives = DERIVING_FIELDS.intersection(varies)
    return {*varies, *(_DERIVED if derives else ())}


def _num_threads(simulations: int) -> int:
    """Number of threads of a Batch: a thread without a simulation would be woken for nothing.

    The local devices of a sharded program step at the same time, so they divide the cores.
    """
    return min(simulations, max(1, usable_cores() // jax.local_device_count()))


def _name_of(mj_model: mujoco.MjModel, substeps: int, varies: Varies) -> str:
    """The name of this model's steps in compiled programs, the same in every process."""
    digest = hashlib.sha256(model_digest(mj_model).encode())
    digest.update(repr(sorted(varies.items())).encode())
    return f"mjx_arm_step_{substeps}_{digest.hexdigest()[:32]}"


def _step_rows(
    pool: BatchPool, layout: _Layout, rows: np.ndarray, out: np.ndarray, *, substeps: int
) -> None:
    """Advances `rows [..., 2 carried + nu + params]` by an iteration into `out [..., out_size]`."""
    rows, out = rows.reshape(-1, rows.shape[-1]), out.reshape(-1, layout.out_size)
    split = layout.carried_words
    with pool.borrow(len(rows)) as batch, mujoco_silence:
        carried = batch.state[:, : layout.carried]
        words = float64_to_words(carried)
        words[:] = rows[:, :split]
        batch.ctrl[:] = rows[:, split : split + batch.model.nu].view(np.float32)
        invalid = _write_params(batch, layout, rows) if layout.params else _NONE
        failed = _advance(batch, substeps)
        failed[invalid] = True
        # The sum is finite where every term is, except for terms that no simulation survives.
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
            model = batch.get_model(int(row)) if layout.params else batch.model
            poses = _poses_before(model, layout, carried[row])
            numbers[row, -len(poses) :] = poses
        if len(invalid):
            _forget_params(batch, layout, invalid)
    out[:, -1] = failed


def _write_params(batch: mj_batch.Batch, layout: _Layout, rows: np.ndarray) -> np.ndarray:
    """Writes each simulation's params into its model; returns the simulations with invalid params.

    The constants that MuJoCo derives depend on the params alone, and take longer than a step. They
    are derived again only where the params differ from those that the Batch holds.
    """
    stale = np.zeros(len(rows), bool)
    for param in layout.params:
        field = batch.expand(param.field)
        values = rows[:, param.words].view(np.float32).reshape(len(rows), *param.shape)
        if param.field in DERIVING_FIELDS:
            differs = field[:, param.ids] != values
            stale |= differs.reshape(len(rows), -1).any(axis=-1)
        field[:, param.ids] = values
    if stale.any():
        try:
            batch.set_const(np.flatnonzero(stale))
        except mj_batch.SimulationError as error:
            return np.asarray(error.ids)
    return _NONE


def _forget_params(batch: mj_batch.Batch, layout: _Layout, simulations: np.ndarray) -> None:
    """Makes the next call derive these simulations' constants, whatever their params are."""
    for param in layout.params:
        if param.field in DERIVING_FIELDS:
            batch.expand(param.field)[np.ix_(simulations, param.ids)] = np.nan


def _poses_before(model: mujoco.MjModel, layout: _Layout, carried: np.ndarray) -> np.ndarray:
    """The poses of a state whose step failed. Kinematics cannot fail again."""
    data = mujoco.MjData(model)
    data.qpos[:] = carried[layout.qpos]
    mujoco.mj_kinematics(model, data)
    return np.concatenate([getattr(data, name).ravel() for name in layout.poses])


def _advance(batch: mj_batch.Batch, substeps: int) -> np.ndarray:
    """Steps every simulation and returns which of them warned or raised: `[N] bool`."""
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
