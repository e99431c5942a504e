"""What an environment is between two steps, and what a step leads to."""

from __future__ import annotations

from typing import Any

import flax.struct
import jax

from mjx_arm.physics import PhysicsState
from mjx_arm.varies import Params

Observation = jax.Array | dict[str, jax.Array]
# Where a task put its objects: a pytree of arrays.
Placement = Any


@flax.struct.dataclass
class EnvState:
    """One environment between two steps.

    Attributes:
      physics: the simulation: `qpos`, `qvel`, poses.
      ctrl: `[nu] float32`, targets of the servos, rad and m.
      step: `[] int32`, iterations since the start of the episode.
      params: values of the model's fields that vary by episode; empty where none do.
      placement: where the episode put the task's objects. Outlives the episode.
      success: `[] bool`, the last step ended in success. Outlives the episode.
      start_samples: `[] int32`, joint angles sampled for the start, the accepted ones included.
      past: what delays and growing ranges need of earlier steps; empty without them. `qpos`
        `[D, nq] float32`, the last states, and `actions` `[E] int32`, the last actions, -1 before
        the first, both newest first; `age` `[] int32`, iterations since the environment was made,
        which outlives the episode.
    """

    physics: PhysicsState
    ctrl: jax.Array
    step: jax.Array
    params: Params
    placement: Placement
    success: jax.Array
    start_samples: jax.Array
    past: dict[str, jax.Array] = flax.struct.field(default_factory=dict)


@flax.struct.dataclass
class Snapshot:
    """What a reward is computed from: a state, and what the task measures in it.

    Attributes:
      state: the state.
      measured: the task's quantities by name, each `[]`; among them `success`, bool.
    """

    state: EnvState
    measured: dict[str, jax.Array]


@flax.struct.dataclass
class Transition:
    """What a step leads to, except for the observation.

    Attributes:
      reward: `[] float32`, the sum of the reward's terms.
      terminated: `[] bool`, the task is done; nothing is to be expected after it.
      truncated: `[] bool`, the episode was cut off: too long, or the simulation diverged.
      metrics: what the task measured, by name: bools and float32, each `[]`.
      info: `success`, `diverged` and `blocked` `[] bool`, and the reward's terms, `reward_*`
        `[] float32`.
    """

    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    metrics: dict[str, jax.Array]
    info: dict[str, jax.Array]
