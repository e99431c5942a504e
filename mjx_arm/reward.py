"""The three rewards, each a dict of named terms."""

from __future__ import annotations

import flax.struct
import jax
import jax.numpy as jnp

from mjx_arm.config import RewardConfig


@flax.struct.dataclass
class Situation:
    """What a reward looks at.

    Attributes:
      distance: `[] float32`, between the gripper and the cube's centre, m.
      height: `[] float32`, of the cube above its rest, m.
      grasped: `[] bool`.
    """

    distance: jax.Array
    height: jax.Array
    grasped: jax.Array


def reward_terms(
    config: RewardConfig, before: Situation, after: Situation, success: jax.Array, lift: float
) -> dict[str, jax.Array]:
    """Terms of one step's reward; the reward is their sum. See `RewardConfig` for the kinds.

    Args:
      config: which reward, and its constants.
      before: the situation that the step started from.
      after: the situation that it led to.
      success: `[] bool`, the step ended the task.
      lift: height at which the task is done, m.

    Returns:
      Each `[] float32`: `reach`, `hold`, `lift` and `success`, or for `progress`, `progress` and
      `success`.
    """
    paid = jnp.where(success, jnp.full_like(after.height, config.success), 0.0)
    if config.kind == "progress":
        terms = {"progress": _progress(config, before, after, success, lift), "success": paid}
    else:
        terms = _by_situation(config, after, success, lift) | {"success": paid}
    return {name: config.scale * term for name, term in terms.items()}


def _by_situation(
    config: RewardConfig, now: Situation, success: jax.Array, lift: float
) -> dict[str, jax.Array]:
    units = now.distance / config.distance_unit
    if config.kind == "paper":
        reach = jnp.exp(-config.distance_decay * units)
        hold = jnp.ones_like(now.height)
        lifted = now.height / config.height_unit
    else:
        reach = config.completion_reach * jnp.exp(-config.completion_decay * units)
        hold = jnp.full_like(now.height, config.completion_hold)
        lifted = config.completion_lift * jnp.sqrt(jnp.clip(now.height / lift, 0.0, 1.0))
    zero = jnp.zeros_like(now.height)
    holding = now.grasped & ~success
    return {
        "reach": jnp.where(now.grasped | success, zero, reach),
        "hold": jnp.where(holding, hold, zero),
        "lift": jnp.where(holding, lifted, zero),
    }


def _progress(
    config: RewardConfig, before: Situation, after: Situation, success: jax.Array, lift: float
) -> jax.Array:
    """`discount * potential(after) - potential(before)`; a state that ends the task has none."""
    gained = jnp.where(success, 0.0, config.discount * _potential(config, after, lift))
    return config.success * (gained - _potential(config, before, lift))


def _potential(config: RewardConfig, now: Situation, lift: float) -> jax.Array:
    """What success is worth from here, discounted over a guess of the steps that it takes."""
    left = lift - jnp.clip(now.height, 0.0, lift)
    to_grasp = config.progress_grasp_steps + config.progress_steps_per_metre * now.distance
    to_lift = config.progress_steps_per_metre * jnp.where(now.grasped, left, lift)
    return config.discount ** (to_lift + jnp.where(now.grasped, 0.0, to_grasp))
