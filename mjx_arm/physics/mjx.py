"""Physics by MuJoCo MJX, on any device that jax runs on.

What varies by episode replaces fields of the model inside the compiled step, and the constants that
MuJoCo derives from them are derived there too.
"""

from __future__ import annotations

import contextlib
import copy
import io
import os
import re
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

# Without the extra `warp`, the import prints that it is missing; the impl "jax" does not need it.
with contextlib.redirect_stdout(io.StringIO()):
    from mujoco import mjx

from mjx_arm.cores import usable_cores
from mjx_arm.kinematics import make_kinematics
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
from mjx_arm.varies import Params, Varies, fill

# MuJoCo's own bound (mjMAXVAL) above which it calls a simulation unstable.
_MAX_VALUE = 1e10
# Enough for the 17 contacts that the scene's pairs allow in 16,384 environments: 80 MB. MJX drops
# contacts beyond this number.
_WARP_CONTACTS = 17 * 16_384
_MJX_NUMERICS = ("max_contact_points", "max_geom_pairs")

# Fields that change the physics of MuJoCo C where they are not zero, and that MJX does not read.
_IGNORED_FIELDS = (
    "actuator_armature",
    "actuator_damping",
    "actuator_dampingpoly",
    "geom_adhesion",
    "geom_surfacevel",
    "pair_adhesion",
)
_INTEGRATORS = tuple(
    int(getattr(mujoco.mjtIntegrator, f"mjINT_{name}")) for name in ("EULER", "RK4", "IMPLICITFAST")
)


def _refuse_to_hang(mj_model: mujoco.MjModel) -> None:
    """Rejects a program that XLA's CPU backend may never finish.

    XLA's batched Cholesky waits on a thread of the pool for pieces that are queued to the same pool
    (`ParallelBatchMap` in jaxlib 0.10). If as many factorisations run at once as there are threads,
    all wait for ever; 256 environments on two cores did. Each device runs one at a time, or two
    where the integrator factorises a second matrix.

    Raises:
      ValueError: as many factorisations may run at once as there are threads.
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


def _reject_what_mjx_ignores(mj_model: mujoco.MjModel) -> None:
    """Rejects models that MJX accepts, but simulates without one of their parts.

    Raises:
      ValueError: names the part.
    """
    ignored = [name for name in _IGNORED_FIELDS if getattr(mj_model, name).any()]
    if mj_model.opt.noslip_iterations:
        ignored.append("noslip_iterations")
    if int(mj_model.opt.integrator) not in _INTEGRATORS:
        ignored.append(_plain(repr(mujoco.mjtIntegrator(mj_model.opt.integrator))))
    if ignored:
        raise ValueError(_not_implemented(", ".join(ignored)))


def _not_implemented(what: str) -> str:
    return f"physics 'mjx' does not implement {what}: change the model, or give physics='native'"


def _plain(message: str) -> str:
    """MuJoCo's message, or its enum's `repr`, with names as they are in MJCF."""
    message = re.sub(r"<(mjt\w+\.\w+): \d+>", r"\1", " ".join(message.split()))
    message = re.sub(
        r"mjt(\w+?)\.mj[A-Z]+_(\w+)", lambda m: f"{m[1].lower()} {m[2].lower()}", message
    )
    ending = r"( collisions?)?( is| are)? not (implemented|supported)( yet| for JAX backend)?\.?$"
    return re.sub(ending, lambda m: m[1] or "", message)


def _put(mj_model: mujoco.MjModel, impl: str) -> tuple[Any, Any]:
    """MJX's model and data.

    Raises:
      ValueError: MJX does not implement a part of the model.
    """
    # The simulations of a batch share one store of contacts, made before their number is known.
    contacts = {"naconmax": _WARP_CONTACTS} if impl == "warp" else {}
    try:
        return mjx.put_model(mj_model, impl=impl), mjx.make_data(mj_model, impl=impl, **contacts)
    except NotImplementedError as error:
        raise ValueError(_not_implemented(_plain(str(error)))) from error


def _place_numerics(told: mujoco.MjModel) -> None:
    """Puts the numerics that MJX reads to where it looks for them.

    MJX 3.17 takes `numeric_data[id]`, which is another numeric's number wherever one before it has
    several (`_numeric` in its collision_driver.py).
    """
    names = [told.numeric(i).name for i in range(told.nnumeric)]
    found = [names.index(name) for name in _MJX_NUMERICS if name in names]
    values = [told.numeric_data[told.numeric_adr[i]] for i in found]
    told.numeric_data[found] = values


def make_mjx(
    mj_model: mujoco.MjModel, substeps: int, varies: Varies = NO_VARIES, impl: str = "jax"
) -> Physics:
    """Makes the backend that runs MJX.

    Args:
      mj_model: the model, checked by `check_model`.
      substeps: number of physics substeps in one iteration.
      varies: the fields and rows that params give, from `physics_varies`.
      impl: MJX's implementation, `"jax"` or `"warp"`.

    Returns:
      The record of functions.

    Raises:
      ValueError: the program could hang on this CPU, MJX does not implement a part of the model, or
        fields vary with the implementation `"warp"`.
    """
    if impl == "jax":
        _reject_what_mjx_ignores(mj_model)
        _refuse_to_hang(mj_model)
    elif varies:
        raise ValueError(
            f"physics 'mjx-warp' cannot vary {', '.join(varies)} by episode: give physics='mjx'"
        )
    kinematics = make_kinematics(mj_model, varies)
    shapes = param_shapes(mj_model, varies)
    # MJX never resets by itself, and its "warp" does not accept the flag that says so.
    told = copy.copy(mj_model)
    told.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    _place_numerics(told)
    model, template = _put(told, impl)
    nv = mj_model.nv

    def init(qpos: jax.Array, ctrl: jax.Array, params: Params = NO_PARAMS) -> PhysicsState:
        integration = at_rest = jnp.zeros((nv,), jnp.float32)
        if mj_model.na:
            integration = jnp.concatenate([at_rest, settled_activations(mj_model, ctrl)])
        return PhysicsState(
            qpos=qpos,
            qvel=at_rest,
            poses=kinematics(qpos, select_params(shapes, params)),
            diverged=jnp.zeros((), jnp.bool_),
            integration=integration,
        )

    def advance(state: PhysicsState, ctrl: jax.Array, params: Params) -> Any:
        fields = {field: fill(mj_model, varies, params, field) for field in varies}
        varied = model.replace(**fields) if fields else model
        if mj_model.nv and DERIVING_FIELDS.intersection(fields):
            varied = _derive(mj_model, varied, template)
        data = template.replace(
            qpos=state.qpos,
            qvel=state.qvel,
            ctrl=ctrl,
            qacc_warmstart=state.integration[:nv] if mj_model.na else state.integration,
        )
        if mj_model.na:
            data = data.replace(act=state.integration[nv:])
        return jax.lax.fori_loop(0, substeps, lambda _, d: mjx.step(varied, d), data)

    def step(state: PhysicsState, ctrl: jax.Array, params: Params = NO_PARAMS) -> PhysicsState:
        params = select_params(shapes, params)
        # MJX mixes dtypes, which must not fail under the caller's own strictness. It also leaves
        # the precision of its products to jax, which would use TF32 on a GPU.
        with jax.numpy_dtype_promotion("standard"), jax.default_matmul_precision("highest"):
            data = advance(state, ctrl, params)
        integration = data.qacc_warmstart
        if mj_model.na:
            integration = jnp.concatenate([integration, data.act])
        after = (data.qpos, data.qvel, integration)
        sane = [jnp.all(jnp.abs(x) < _MAX_VALUE) for x in after]
        diverged = ~(sane[0] & sane[1] & sane[2])
        before = (state.qpos, state.qvel, state.integration)
        qpos, qvel, integration = (
            jnp.where(diverged, old, new) for old, new in zip(before, after, strict=True)
        )
        return PhysicsState(
            qpos=qpos,
            qvel=qvel,
            poses=kinematics(qpos, params),
            diverged=diverged,
            integration=integration,
        )

    backend = "mjx" if impl == "jax" else "mjx-warp"
    return Physics(backend, init, step, substeps, float(mj_model.opt.timestep), varies=varies)


def _derive(mj_model: mujoco.MjModel, model: Any, template: Any) -> Any:
    """The model with the constants that `mj_setConst` derives and MJX reads.

    They are: masses of subtrees, inverse weights of bodies, joints and tendons at `qpos0`,
    lengths of tendons, accelerations of actuators by a unit force, and bounding radii of geoms.
    """
    model = model.replace(
        body_subtreemass=_subtree_mass(mj_model, model.body_mass),
        geom_rbound=_bounding_radii(mj_model, model),
    )
    data = template.replace(qpos=jnp.asarray(mj_model.qpos0, jnp.float32))
    for stage in (mjx.kinematics, mjx.com_pos, mjx.tendon, mjx.crb, mjx.tendon_armature):
        data = stage(model, data)
    data = mjx.transmission(model, data)
    inverse = _inverse(mjx.full_m(model, data))

    def weight(jacobian: jax.Array) -> jax.Array:
        """The diagonal of `J M^-1 J^T`."""
        return jnp.einsum("ij,jk,ik->i", jacobian, inverse, jacobian)

    bodies = jnp.arange(mj_model.nbody)
    jacobians = jax.vmap(lambda point, body: mjx.jac(model, data, point, body))(data.xipos, bodies)
    translation, rotation = (
        jnp.mean(jax.vmap(weight)(jnp.swapaxes(x, -1, -2)), axis=-1) for x in jacobians
    )
    pairs = jnp.stack([translation, rotation], axis=-1)
    pairs = jnp.where(np.asarray(mj_model.body_weldid)[:, None] != 0, pairs, 0.0)
    # MuJoCo takes a short cut where a body only slides: 1 / mass, whatever the armature.
    slides = np.asarray(mj_model.body_simple) == 2
    by_mass = 1 / jnp.where(slides, model.body_mass, 1.0)
    pairs = jnp.where(slides[:, None], by_mass[:, None] * np.asarray([1.0, 0.0], np.float32), pairs)
    dofs = np.asarray(mj_model.dof_bodyid)
    joints = _joint_means(mj_model, jnp.diagonal(inverse))
    moment = data._impl.actuator_moment
    return model.replace(
        body_invweight0=pairs,
        dof_invweight0=jnp.where(slides[dofs], by_mass[dofs], joints),
        tendon_invweight0=weight(data._impl.ten_J),
        tendon_length0=data.ten_length,
        actuator_acc0=jnp.linalg.norm(moment @ inverse, axis=-1),
    )


def _subtree_mass(mj_model: mujoco.MjModel, mass: jax.Array) -> jax.Array:
    """`[nbody] float32`: each body's mass and that of all bodies below it, kg."""
    below = np.eye(mj_model.nbody, dtype=np.float32)
    for body in range(mj_model.nbody - 1, 0, -1):
        below[mj_model.body_parentid[body]] += below[body]
    return jnp.asarray(below) @ mass


def _joint_means(mj_model: mujoco.MjModel, diagonal: jax.Array) -> jax.Array:
    """`[nv] float32`, averaged over the translations and over the rotations of a free joint."""
    mean = np.eye(mj_model.nv, dtype=np.float32)
    for joint in range(mj_model.njnt):
        if int(mj_model.jnt_type[joint]) == int(mujoco.mjtJoint.mjJNT_FREE):
            start = mj_model.jnt_dofadr[joint]
            for first in (start, start + 3):
                mean[first : first + 3, first : first + 3] = 1 / 3
    return jnp.asarray(mean) @ diagonal


def _bounding_radii(mj_model: mujoco.MjModel, model: Any) -> jax.Array:
    """`[ngeom] float32`, radii of bounding spheres, m; 0 for planes."""
    kinds, size = mj_model.geom_type, model.geom_size
    geom = mujoco.mjtGeom
    radii = {
        geom.mjGEOM_SPHERE: size[:, 0],
        geom.mjGEOM_CAPSULE: size[:, 0] + size[:, 1],
        geom.mjGEOM_ELLIPSOID: jnp.max(size, axis=-1),
        geom.mjGEOM_CYLINDER: jnp.linalg.norm(size[:, :2], axis=-1),
        geom.mjGEOM_BOX: jnp.linalg.norm(size, axis=-1),
    }
    result = model.geom_rbound
    for kind, radius in radii.items():
        result = jnp.where(kinds == int(kind), radius, result)
    return result


def _inverse(matrix: jax.Array) -> jax.Array:
    """Inverse of a positive definite `[n, n]` matrix by elimination.

    XLA's own factorisations could hang on CPU beside the one of the step; see `_refuse_to_hang`.
    """

    def eliminate(k: jax.Array, both: jax.Array) -> jax.Array:
        row = both[k] / both[k, k]
        return (both - jnp.outer(both[:, k], row)).at[k].set(row)

    n = matrix.shape[0]
    both = jnp.concatenate([matrix, jnp.eye(n, dtype=matrix.dtype)], axis=1)
    return jax.lax.fori_loop(0, n, eliminate, both)[:, n:]
