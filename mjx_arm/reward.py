"""The two rewards, each a dict of named terms."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from mjx_arm.config import RewardConfig


def reward_terms(
    config: RewardConfig,
    *,
    distance: jax.Array,
    height: jax.Array,
    grasped: jax.Array,
    success: jax.Array,
    lift: float,
) -> dict[str, jax.Array]:
    """Terms of one step's reward; the reward is their sum.

    `paper` is Algorithm 1 of James & Johns 2016: 100 on success, else `1 + height` while grasped,
    else `exp(-0.25 * distance)`. `completion` keeps the shape but bounds what a step without
    success can pay, so that at discount 0.99 no hovering is worth as much as finishing.

    Args:
      config: which reward, and its constants.
      distance: `[] float32`, between the gripper and the cube's centre, m.
      height: `[] float32`, of the cube above its rest, m.
      grasped: `[] bool`.
      success: `[] bool`.
      lift: height at which the episode succeeds, m.

    Returns:
      `reach`, `hold`, `lift` and `success`, each `[] float32`.
    """
    units = distance / config.distance_unit
    if config.kind == "paper":
        reach = jnp.exp(-config.distance_decay * units)
        hold = jnp.ones_like(height)
        lifted = height / config.height_unit
    else:
        reach = config.completion_reach * jnp.exp(-config.completion_decay * units)
        hold = jnp.full_like(height, config.completion_hold)
        lifted = config.completion_lift * jnp.sqrt(jnp.clip(height / lift, 0.0, 1.0))
    zero = jnp.zeros_like(height)
    holding = grasped & ~success
    terms = {
        "reach": jnp.where(grasped | success, zero, reach),
        "hold": jnp.where(holding, hold, zero),
        "lift": jnp.where(holding, lifted, zero),
        "success": jnp.where(success, jnp.full_like(height, config.success), zero),
    }
    return {name: config.scale * term for name, term in terms.items()}
