"""Where an episode starts: joints around home and a place for the cube, nothing penetrating."""

from __future__ import annotations

import dataclasses
from typing import TypeAlias

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.scipy.spatial.transform import Rotation

from mjx_arm.config import EnvConfig
from mjx_arm.kinematics import Poses, make_kinematics
from mjx_arm.scene import Scene, TaskIds

# Draws before a start falls back to home, which is free. At the measured acceptance the chance of
# that is below 1e-9.
MAX_DRAWS = 32
_CLEARANCE = 0.002
_SQUEEZE = 0.0005

_BOX = int(mujoco.mjtGeom.mjGEOM_BOX)
_PLANE = int(mujoco.mjtGeom.mjGEOM_PLANE)
_SPHERE = int(mujoco.mjtGeom.mjGEOM_SPHERE)

# Key, joints, number of draws, whether they are free.
_Draw: TypeAlias = tuple[jax.Array, jax.Array, jax.Array, jax.Array]


@dataclasses.dataclass(frozen=True)
class Starts:
    """Draws the start of an episode.

    Attributes:
      scene: the scene.
      ids: the task's ids in it.
      config: how joints and cube vary.
    """

    scene: Scene
    ids: TaskIds
    config: EnvConfig

    def cube_place(self, key: jax.Array) -> jax.Array:
        """A place for the cube, uniform in its rectangle: `[2] float32`, m. Consumes the key."""
        if self.config.cube_moves == "never":
            return jnp.asarray(self.ids.home_qpos[self.ids.cube_qpos : self.ids.cube_qpos + 2])
        centre, half = self.ids.cube_rectangle[:2], self.ids.cube_rectangle[2:]
        return jax.random.uniform(
            key, (2,), jnp.float32, jnp.asarray(centre - half), jnp.asarray(centre + half)
        )

    def draw(
        self, key: jax.Array, cube_place: jax.Array, needed: jax.Array | bool = True
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Draws joints until nothing penetrates, at most `MAX_DRAWS` times.

        Args:
          key: consumed.
          cube_place: `[2] float32`, m.
          needed: `[] bool`; where false nothing is drawn and the result means nothing. Under vmap
            the loop runs as long as any environment needs a start, and not at all where none does.

        Returns:
          `qpos [nq] float32`, `ctrl [nu] float32`, and the number of draws `[] int32`.
        """
        home = jnp.asarray(self.ids.home_qpos[self.ids.arm_qpos])
        if self.config.joint_noise == 0.0:
            return *self._assemble(home, cube_place), jnp.ones((), jnp.int32)
        kinematics = make_kinematics(self.scene.mj_model)
        noise = np.float32(np.deg2rad(self.config.joint_noise))

        def unfinished(carry: _Draw) -> jax.Array:
            _, _, draws, free = carry
            return needed & ~free & (draws < MAX_DRAWS)

        def redraw(carry: _Draw) -> _Draw:
            key, _, draws, _ = carry
            key, draw_key = jax.random.split(key)
            joints = home + jax.random.uniform(draw_key, home.shape, jnp.float32, -noise, noise)
            qpos, _ = self._assemble(joints, cube_place)
            return key, joints, draws + 1, self.is_free(kinematics(qpos))

        first = (key, home, jnp.zeros((), jnp.int32), jnp.zeros((), jnp.bool_))
        _, joints, draws, free = jax.lax.while_loop(unfinished, redraw, first)
        return *self._assemble(jnp.where(free, joints, home), cube_place), draws

    def is_free(self, poses: Poses) -> jax.Array:
        """Whether no link is in the table or, unless held, near the cube: `[] bool`.

        Exact against the table. The cube is taken for its bounding sphere, and each link for the
        box around it, so that a few free starts are rejected as well.
        """
        model, ids = self.scene.mj_model, self.ids
        moving = _moving_geoms(model, ids)
        half = _half_extents(model)[moving]
        xpos, xmat = poses.geom_xpos[moving], poses.geom_xmat[moving]
        lowest = xpos[:, 2] - _reach_down(model, moving, xmat, half)
        free = jnp.all(lowest > _CLEARANCE)
        if self.config.start == "in_grasp":
            return free
        to_cube = poses.geom_xpos[ids.cube_geom] - xpos
        local = jnp.abs(jnp.sum(to_cube[:, :, None] * xmat, axis=1))
        gap = jnp.sqrt(jnp.sum(jnp.square(jnp.maximum(local - half, 0.0)), axis=-1))
        cube_radius = np.float32(ids.cube_half_size * np.sqrt(3) + _CLEARANCE)
        return free & jnp.all(gap > cube_radius)

    def _assemble(self, joints: jax.Array, cube_place: jax.Array) -> tuple[jax.Array, jax.Array]:
        ids = self.ids
        qpos = jnp.asarray(ids.home_qpos).at[ids.arm_qpos].set(joints)
        ctrl = jnp.asarray(ids.home_ctrl).at[ids.arm_ctrl].set(joints)
        if self.config.start == "in_grasp":
            qpos = qpos.at[ids.finger_qpos].set(np.float32(ids.cube_half_size - _SQUEEZE))
            ctrl = ctrl.at[ids.gripper_ctrl].set(ids.ctrl_range[ids.gripper_ctrl, 0])
            poses = make_kinematics(self.scene.mj_model)(qpos)
            # The pads are spheres without a rotation of their own, so theirs is the gripper's.
            gripper = poses.geom_xmat[ids.pad_geoms[0, 0]]
            cube = jnp.concatenate([poses.site_xpos[ids.grasp_site], _mat_to_quat(gripper)])
            return qpos.at[ids.cube_qpos : ids.cube_qpos + 7].set(cube), ctrl
        return qpos.at[ids.cube_qpos : ids.cube_qpos + 2].set(cube_place), ctrl


def _moving_geoms(model: mujoco.MjModel, ids: TaskIds) -> np.ndarray:
    moving = model.body_weldid[model.geom_bodyid] != 0
    moving[ids.cube_geom] = False
    # The first link turns on its foot and cannot touch anything that the foot does not.
    first_link = model.jnt_bodyid[np.flatnonzero(model.jnt_qposadr == ids.arm_qpos[0])]
    return np.flatnonzero(moving & (model.geom_bodyid != first_link))


def _half_extents(model: mujoco.MjModel) -> np.ndarray:
    """Half extents of the box around each geom in its own frame: `[ngeom, 3] float32`, m."""
    half = model.geom_aabb[:, 3:].copy()
    half[model.geom_type == _PLANE] = 0.0
    return half.astype(np.float32)


def _reach_down(
    model: mujoco.MjModel, geoms: np.ndarray, xmat: jax.Array, half: np.ndarray
) -> jax.Array:
    """How far each geom reaches below its centre: `[G] float32`, m."""
    is_box = np.isin(model.geom_type[geoms], [_BOX, int(mujoco.mjtGeom.mjGEOM_CYLINDER)])
    radius = np.where(is_box, 0.0, half[:, 0]).astype(np.float32)
    # A capsule or sphere is a segment (or point) with a radius; a box has none.
    core = np.where(is_box[:, None], half, half * np.asarray([0, 0, 1]) - radius[:, None])
    core = np.maximum(core, 0.0).astype(np.float32)
    return jnp.asarray(radius) + jnp.sum(jnp.abs(xmat[:, 2, :]) * core, axis=-1)


def _mat_to_quat(mat: jax.Array) -> jax.Array:
    """`[3, 3]` rotation to `[4] float32` (w, x, y, z)."""
    return Rotation.from_matrix(mat).as_quat(scalar_first=True)
