"""Where an episode starts: joints around home and the task's objects, nothing penetrating."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import TypeAlias, cast

import jax
import jax.numpy as jnp
import numpy as np

from mjx_arm.envs.arm import Arm
from mjx_arm.envs.collision import Collision
from mjx_arm.envs.config import EnvConfig
from mjx_arm.envs.state import Placement
from mjx_arm.envs.tasks.base import EasedTask, Task
from mjx_arm.kinematics import Poses
from mjx_arm.varies import Params

# Samples before a start falls back to home, which is free. At the measured acceptance the chance of
# that is below 1e-9.
MAX_SAMPLES = 32

# What is folded into the key of a start to make the key of `ease`.
_EASE = 1

# Key, joints, number of samples, whether the last one is free.
_Sample: TypeAlias = tuple[jax.Array, jax.Array, jax.Array, jax.Array]


@dataclasses.dataclass(frozen=True, eq=False)
class StartSampler:
    """Samples the start of an episode.

    Attributes:
      arm: the arm.
      task: places its objects.
      collision: whether the arm keeps clear of itself, its base, the ground and the objects.
      kinematics: poses of a `qpos`.
      config: how joints and objects vary.
      add_params: adds to the params of the task what else varies in the episode.
    """

    arm: Arm
    task: Task
    collision: Collision
    kinematics: Callable[[jax.Array, Params], Poses]
    config: EnvConfig
    add_params: Callable[[Params], Params] = lambda params: params

    def sample(
        self, key: jax.Array, placement: Placement, wanted: jax.Array | bool = True
    ) -> tuple[jax.Array, jax.Array, Params, jax.Array]:
        """Samples joints until the arm is free and the task accepts, at most `MAX_SAMPLES` times.

        Args:
          key: consumed.
          placement: where the task's objects go.
          wanted: `[] bool`; where false nothing is sampled and the result means nothing. Under
            vmap the loop runs as long as any environment needs a start, and not at all where none
            does.

        Returns:
          `qpos [nq] float32`, `ctrl [nu] float32`, the params of the episode, and the number of
          samples `[] int32`.
        """
        home = jnp.asarray(self.arm.home_qpos[self.arm.qpos])
        if self.config.noise_degrees == 0.0:
            return *self._eased(key, home, placement), jnp.ones((), jnp.int32)
        degrees = self.config.noise_degrees
        noise = np.where(self.arm.slides, degrees / 1000.0, np.deg2rad(degrees)).astype(np.float32)
        low, high = self.arm.ctrl_range[self.arm.ctrl].T

        def unfinished(carry: _Sample) -> jax.Array:
            _, _, samples, free = carry
            return wanted & ~free & (samples < MAX_SAMPLES)

        def sample_again(carry: _Sample) -> _Sample:
            key, _, samples, _ = carry
            key, joint_key = jax.random.split(key)
            offset = jax.random.uniform(joint_key, home.shape, jnp.float32, -noise, noise)
            joints = jnp.clip(home + offset, low, high)
            return key, joints, samples + 1, self._is_free(joints, placement)

        first = (key, home, jnp.zeros((), jnp.int32), jnp.zeros((), jnp.bool_))
        _, joints, samples, free = jax.lax.while_loop(unfinished, sample_again, first)
        return *self._eased(key, jnp.where(free, joints, home), placement), samples

    def _eased(
        self, key: jax.Array, joints: jax.Array, placement: Placement
    ) -> tuple[jax.Array, jax.Array, Params]:
        qpos, ctrl, params = self._assemble(joints, placement)
        if hasattr(self.task, "ease"):
            qpos, ctrl = cast(EasedTask, self.task).ease(jax.random.fold_in(key, _EASE), qpos, ctrl)
        return qpos, ctrl, params

    def _is_free(self, joints: jax.Array, placement: Placement) -> jax.Array:
        qpos, _, params = self._assemble(joints, placement)
        poses = self.kinematics(qpos, params)
        return self.collision.is_free(poses) & self.task.accepts(poses, placement)

    def _assemble(
        self, joints: jax.Array, placement: Placement
    ) -> tuple[jax.Array, jax.Array, Params]:
        qpos = jnp.asarray(self.arm.home_qpos).at[self.arm.qpos].set(joints)
        ctrl = jnp.asarray(self.arm.home_ctrl).at[self.arm.ctrl].set(joints)
        qpos, ctrl, params = self.task.start(qpos, ctrl, placement)
        return qpos, ctrl, self.add_params(params)
