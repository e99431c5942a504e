"""What the physics backends share: the state, the record of functions, and what may vary."""

from __future__ import annotations

import dataclasses
import operator
from collections.abc import Callable, Mapping
from typing import Any, Protocol

import flax.struct
import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_arm.kinematics import Poses
from mjx_arm.varies import Params, Varies, check_varies

BACKENDS = ("auto", "mjx", "mjx-warp", "native")

NO_PARAMS: Params = {}
NO_VARIES: Varies = {}

# MuJoCo derives constants from these: weights of constraints, bounding volumes, frames.
DERIVING_FIELDS = frozenset(
    {
        "body_inertia",
        "body_mass",
        "body_pos",
        "body_quat",
        "dof_armature",
        "geom_pos",
        "geom_quat",
        "geom_size",
    }
)
# All that both backends read by simulation.
FIELDS = DERIVING_FIELDS | frozenset(
    {
        "actuator_biasprm",
        "actuator_forcerange",
        "actuator_gainprm",
        "dof_damping",
        "geom_friction",
        "geom_solimp",
        "geom_solref",
        "pair_friction",
        "pair_solimp",
        "pair_solref",
    }
)
# Fields that physics does not read begin with one of these: they change the image, or the delay of
# actions, which the environment sees to.
_OTHERS_PREFIXES = (
    "action_delay",
    "cam_",
    "geom_rgba",
    "headlight_",
    "image_",
    "light_",
    "mat_",
    "site_rgba",
    "site_size",
    "skin_rgba",
)
_SHAPED = tuple(
    int(getattr(mujoco.mjtGeom, f"mjGEOM_{name}"))
    for name in ("PLANE", "SPHERE", "CAPSULE", "ELLIPSOID", "CYLINDER", "BOX")
)


@flax.struct.dataclass
class PhysicsState:
    """One simulation at the end of an iteration.

    Attributes:
      qpos: `[nq] float32`, m and rad.
      qvel: `[nv] float32`, m/s and rad/s.
      poses: of geoms and sites at this `qpos`.
      diverged: `[] bool`, the iteration that led here raised a MuJoCo warning or error, or its
        result is not finite. `qpos` and `poses` are then those before the iteration.
      integration: what the backend needs in order to continue exactly, activations included. Only
        the backend that made it can read it.
    """

    qpos: jax.Array
    qvel: jax.Array
    poses: Poses
    diverged: jax.Array
    integration: Any


class Init(Protocol):
    """`init(qpos, ctrl, params)`; see `Physics`."""

    def __call__(
        self, qpos: jax.Array, ctrl: jax.Array, params: Params = NO_PARAMS
    ) -> PhysicsState:
        """Returns a simulation at rest."""


class Step(Protocol):
    """`step(state, ctrl, params)`; see `Physics`."""

    def __call__(
        self, state: PhysicsState, ctrl: jax.Array, params: Params = NO_PARAMS
    ) -> PhysicsState:
        """Returns the simulation one iteration later."""


@dataclasses.dataclass(frozen=True)
class Physics:
    """Pure functions over one simulation; jit- and vmap-able, also nested.

    Attributes:
      backend: `"native"`, `"mjx"` or `"mjx-warp"`.
      init: `(qpos [nq] float32, ctrl [nu] float32, params={}) -> PhysicsState`, at rest.
        Activations of servos with a time constant start at `ctrl`, as if it had long been given;
        other activations start at 0.
      step: `(state, ctrl [nu] float32, params={}) -> PhysicsState`, one iteration of `substeps`
        substeps. It reads the params that it is given and remembers none.
      substeps: number of physics substeps in one iteration.
      timestep: length of one substep, s.
      host_memory: from a number of simulations, the bytes that the host holds beside their states.
      varies: the fields and rows that `params` must give; what physics does not read is left out.
    """

    backend: str
    init: Init
    step: Step
    substeps: int
    timestep: float
    host_memory: Callable[[int], int] = lambda simulations: 0
    varies: Varies = dataclasses.field(default_factory=dict, hash=False)


def whole_number(name: str, value: object) -> int:
    """Checks a count.

    Raises:
      ValueError: the value is not a whole number of at least 1.
    """
    try:
        number = 0 if isinstance(value, bool | np.bool_) else operator.index(value)  # type: ignore[arg-type]
    except TypeError:
        number = 0
    if number < 1:
        raise ValueError(f"{name} must be a whole number of at least 1, got {value!r}")
    return number


def check_model(mj_model: mujoco.MjModel) -> None:
    """Checks that a simulation's state is one that the backends carry.

    Raises:
      ValueError: the model has state that would be lost between two iterations.
    """
    sleep = mujoco.mjtEnableBit.mjENBL_SLEEP | mujoco.mjtEnableBit.mjENBL_IPC
    lost = {
        "plugins": mj_model.nplugin,
        "mocap bodies": mj_model.nmocap,
        "delays of actuators or sensors (history)": mj_model.nhistory,
        "user data": mj_model.nuserdata,
        "the flags 'sleep' or 'ipc'": mj_model.opt.enableflags & sleep,
    }
    for name, found in lost.items():
        if found:
            raise ValueError(f"physics supports no {name}: remove them from the model")


def physics_varies(mj_model: mujoco.MjModel, varies: Varies | None) -> Varies:
    """The part of what varies by episode that physics reads, in the order of its names.

    Args:
      mj_model: the model.
      varies: names of fields and ids of rows. Fields of the image alone are ignored. `body_mass`
        does not change `body_inertia`, and `geom_size` changes neither: vary them together where
        they belong together. Contacts of explicit pairs read `pair_friction`, not `geom_friction`.

    Raises:
      ValueError: an unknown field or row, a field that physics would need but cannot vary, or the
        size of a geom that has a mesh or a height field.
    """
    varies = {} if varies is None else varies
    check_varies(mj_model, varies)
    read = {}
    for field in sorted(varies):
        if field.startswith(_OTHERS_PREFIXES):
            continue
        if field not in FIELDS:
            raise ValueError(
                f"physics cannot vary {field!r} by episode: give one of {', '.join(sorted(FIELDS))}"
            )
        read[field] = tuple(operator.index(i) for i in varies[field])
    for geom in read.get("geom_size", ()):
        if int(mj_model.geom_type[geom]) not in _SHAPED:
            raise ValueError(
                f"physics cannot vary 'geom_size' of geom {geom} "
                f"({mj_model.geom(geom).name!r}): only primitives have a size"
            )
    return read


def param_shapes(mj_model: mujoco.MjModel, varies: Varies) -> dict[str, tuple[int, ...]]:
    """Shapes of the params that physics reads."""
    return {f: (len(ids), *getattr(mj_model, f).shape[1:]) for f, ids in varies.items()}


def select_params(shapes: Mapping[str, tuple[int, ...]], params: Params) -> dict[str, jax.Array]:
    """The params that physics reads, float32.

    Raises:
      ValueError: a field is missing, or its shape is wrong.
    """
    selected = {}
    for field, shape in shapes.items():
        if field not in params:
            raise ValueError(f"params need {field!r}, {list(shape)} float32: it varies by episode")
        value = jnp.asarray(params[field], jnp.float32)
        if value.shape != shape:
            raise ValueError(f"params: {field!r} must be {list(shape)}, got {list(value.shape)}")
        selected[field] = value
    return selected


def settled_activations(mj_model: mujoco.MjModel, ctrl: jax.Array) -> jax.Array:
    """Activations of servos that were given `ctrl` for a long time: `[na] float32`.

    A filter settles at its control. An integrator or a muscle starts at 0, like MuJoCo's reset.
    """
    act = jnp.zeros((mj_model.na,), jnp.float32)
    filters = (int(mujoco.mjtDyn.mjDYN_FILTER), int(mujoco.mjtDyn.mjDYN_FILTEREXACT))
    clamps = not mj_model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL
    for i in range(mj_model.nu):
        if int(mj_model.actuator_dyntype[i]) not in filters:
            continue
        value = ctrl[i]
        if mj_model.actuator_ctrllimited[i] and clamps:
            value = jnp.clip(value, *mj_model.actuator_ctrlrange[i].astype(np.float32))
        if mj_model.actuator_actlimited[i]:
            value = jnp.clip(value, *mj_model.actuator_actrange[i].astype(np.float32))
        last = mj_model.actuator_actadr[i] + mj_model.actuator_actnum[i] - 1
        act = act.at[last].set(value)
    return act
