"""Is an arm free of its base, the ground and some obstacles?"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_arm.envs.arm import Arm
from mjx_arm.envs.tasks.base import Obstacle
from mjx_arm.kinematics import Poses

_MARGIN = 0.002

_BOX = int(mujoco.mjtGeom.mjGEOM_BOX)
_CYLINDER = int(mujoco.mjtGeom.mjGEOM_CYLINDER)
_PLANE = int(mujoco.mjtGeom.mjGEOM_PLANE)


@dataclasses.dataclass(frozen=True, eq=False)
class Clearance:
    """Checks of an arm's pose.

    Attributes:
      model: the model.
      links: `[G] int`, geom ids of the links that can touch something.
    """

    model: mujoco.MjModel
    links: np.ndarray

    def is_free(self, poses: Poses, obstacles: Sequence[Obstacle]) -> jax.Array:
        """Whether no link is in the ground or near an obstacle: `[] bool`.

        Exact against the ground. Each link counts as the box around it, so that a few free poses
        are rejected as well.
        """
        half = _half_extents(self.model)[self.links]
        xpos, xmat = poses.geom_xpos[self.links], poses.geom_xmat[self.links]
        lowest = xpos[:, 2] - _reach_down(self.model, self.links, xmat, half)
        free = jnp.all(lowest > _MARGIN)
        for obstacle in obstacles:
            offset = poses.geom_xpos[obstacle.geom] - xpos
            local = jnp.abs(jnp.sum(offset[:, :, None] * xmat, axis=1))
            gap = jnp.sqrt(jnp.sum(jnp.square(jnp.maximum(local - half, 0.0)), axis=-1))
            free = free & jnp.all(gap > np.float32(obstacle.radius + _MARGIN))
        return free

    def blocks(self, qpos: jax.Array, ctrl: jax.Array, wanted: jax.Array) -> jax.Array:
        """Whether an action is not carried out, `[] bool`."""
        del qpos, ctrl, wanted
        return jnp.zeros((), jnp.bool_)


def make_clearance(model: mujoco.MjModel, arm: Arm) -> Clearance:
    """Makes the checks for an arm."""
    moving = np.zeros(model.ngeom, bool)
    for geom, body in enumerate(model.geom_bodyid):
        # The first link turns on its foot and cannot touch anything that the foot does not.
        moving[geom] = body != arm.first_link and _is_below(model, int(body), arm.first_link)
    return Clearance(model, np.flatnonzero(moving))


def _is_below(model: mujoco.MjModel, body: int, ancestor: int) -> bool:
    while body > 0:
        if body == ancestor:
            return True
        body = int(model.body_parentid[body])
    return False


def _half_extents(model: mujoco.MjModel) -> np.ndarray:
    """Half extents of the box around each geom in its own frame: `[ngeom, 3] float32`, m."""
    half = model.geom_aabb[:, 3:].copy()
    half[model.geom_type == _PLANE] = 0.0
    return half.astype(np.float32)


def _reach_down(
    model: mujoco.MjModel, geoms: np.ndarray, xmat: jax.Array, half: np.ndarray
) -> jax.Array:
    """How far each geom reaches below its centre: `[G] float32`, m."""
    is_box = np.isin(model.geom_type[geoms], [_BOX, _CYLINDER])
    radius = np.where(is_box, 0.0, half[:, 0]).astype(np.float32)
    # A capsule or sphere is a segment (or point) with a radius; a box has none.
    core = np.where(is_box[:, None], half, half * np.asarray([0, 0, 1]) - radius[:, None])
    core = np.maximum(core, 0.0).astype(np.float32)
    return jnp.asarray(radius) + jnp.sum(jnp.abs(xmat[:, 2, :]) * core, axis=-1)
