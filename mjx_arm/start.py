"""Where an episode starts: joints around home and a place for the cube, nothing penetrating."""

from __future__ import annotations

import dataclasses
import functools
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.spatial.transform import Rotation

from mjx_arm.config import EnvConfig
from mjx_arm.envs.collision import Collision, Obstacle, make_self_collision
from mjx_arm.kinematics import make_kinematics
from mjx_arm.scene import Scene, TaskIds

# Draws before a start falls back to home, which is free. At the measured acceptance the chance of
# that is below 1e-9.
MAX_DRAWS = 32
_SQUEEZE = 0.0005

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

    @functools.cached_property
    def collision(self) -> Collision:
        """What a start keeps apart: the arm, the table and, unless held, the cube.

        The cube is taken for its bounding sphere, so that a few free starts are rejected as well.
        """
        radius = float(self.ids.cube_half_size * np.sqrt(3))
        cube = [] if self.config.start == "in_grasp" else [Obstacle(self.ids.cube_geom, radius)]
        return make_self_collision(self.scene.mj_model, obstacles=cube)

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
        is_free = self.collision.is_free
        noise = np.float32(np.deg2rad(self.config.joint_noise))

        def unfinished(carry: _Draw) -> jax.Array:
            _, _, draws, free = carry
            return needed & ~free & (draws < MAX_DRAWS)

        def redraw(carry: _Draw) -> _Draw:
            key, _, draws, _ = carry
            key, draw_key = jax.random.split(key)
            joints = home + jax.random.uniform(draw_key, home.shape, jnp.float32, -noise, noise)
            qpos, _ = self._assemble(joints, cube_place)
            return key, joints, draws + 1, is_free(kinematics(qpos))

        first = (key, home, jnp.zeros((), jnp.int32), jnp.zeros((), jnp.bool_))
        _, joints, draws, free = jax.lax.while_loop(unfinished, redraw, first)
        return *self._assemble(jnp.where(free, joints, home), cube_place), draws

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


def _mat_to_quat(mat: jax.Array) -> jax.Array:
    """`[3, 3]` rotation to `[4] float32` (w, x, y, z)."""
    return Rotation.from_matrix(mat).as_quat(scalar_first=True)
