"""The environment: reset, step and observe, pure and for a single environment.

`env.step` never resets; `mjx_arm.auto_reset` does.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from mjx_arm.config import EnvConfig, env_config
from mjx_arm.kinematics import Poses
from mjx_arm.physics import Physics, PhysicsState, make_physics
from mjx_arm.render import make_renderer, rgb, segmentation
from mjx_arm.render.renderer import Render, RenderWithDepth
from mjx_arm.reward import Situation, reward_terms
from mjx_arm.scene import Scene, TaskIds, load_scene, resolve_task
from mjx_arm.start import Starts
from mjx_arm.task import NUM_ACTIONS, apply_action, grasped

Observation = jax.Array | dict[str, jax.Array]
Info = dict[str, jax.Array]


@flax.struct.dataclass
class EnvState:
    """One environment between two steps.

    Attributes:
      physics: the simulation.
      ctrl: `[nu] float32`, targets of the servos, rad and m.
      step: `[] int32`, iterations since the start of the episode.
      cube_place: `[2] float32`, where the episode put the cube, m. Outlives the episode.
      success: `[] bool`, the episode ended in success. Outlives the episode.
      start_draws: `[] int32`, draws of joints that the start took, the accepted one included.
    """

    physics: PhysicsState
    ctrl: jax.Array
    step: jax.Array
    cube_place: jax.Array
    success: jax.Array
    start_draws: jax.Array


@flax.struct.dataclass
class Transition:
    """What a step leads to, but for the observation.

    Attributes:
      reward: `[] float32`.
      terminated: `[] bool`, the cube is grasped and lifted; nothing is to be expected after it.
      truncated: `[] bool`, the episode was cut off: too long, or the simulation diverged.
      info: `grasped`, `success`, `diverged` `[] bool`; `height`, `distance` `[] float32`, m; and
        the terms of the reward, `reward_*` `[] float32`.
    """

    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    info: Info


@dataclasses.dataclass(frozen=True, eq=False)
class Env:
    """A robot arm that is to grasp a cube and lift it; made by `mjx_arm.make`.

    Attributes:
      config: the options.
      scene: the compiled scene.
      ids: the task's ids in it.
      physics: the backend's functions.
      starts: draws the starts of episodes.
      render: draws an image from the poses of the geoms.
    """

    config: EnvConfig
    scene: Scene
    ids: TaskIds
    physics: Physics
    starts: Starts
    render: Render | RenderWithDepth

    def draw(self, poses: Poses) -> jax.Array:
        """Packed pixels of a scene in these poses, `[H, W] uint32`."""
        image = self.render(poses.geom_xpos, poses.geom_xmat)
        return image[0] if isinstance(image, tuple) else image

    @property
    def num_actions(self) -> int:
        """Number of discrete actions."""
        return NUM_ACTIONS

    def reset(self, key: jax.Array) -> tuple[Observation, EnvState]:
        """Starts an episode that owes nothing to an earlier one. Consumes the key.

        Returns:
          The observation and the state.
        """
        place_key, start_key = jax.random.split(key)
        state = self._start(start_key, self.starts.cube_place(place_key), True)
        return self.observe(state), state

    def restart(self, key: jax.Array, state: EnvState, needed: jax.Array | bool = True) -> EnvState:
        """Starts the next episode, with what outlives the last one. Consumes the key.

        Args:
          key: a PRNG key.
          state: the last state of the episode that has ended.
          needed: `[] bool`; where false the result means nothing, and drawing it costs less.

        Returns:
          The state that the next episode starts from.
        """
        place_key, start_key = jax.random.split(key)
        place = self.starts.cube_place(place_key)
        if self.config.cube_moves == "on_success":
            place = jnp.where(state.success, place, state.cube_place)
        return self._start(start_key, place, needed)

    def step(
        self, key: jax.Array, state: EnvState, action: jax.Array | int
    ) -> tuple[Observation, EnvState, jax.Array, jax.Array, jax.Array, Info]:
        """Advances by one iteration; never resets.

        Args:
          key: not consumed, the physics being deterministic; there for the common interface.
          state: the state before.
          action: `[] int32`, 0 to 13.

        Returns:
          observation, state, reward, terminated, truncated and info, as in `Transition`.

        Raises:
          ValueError: the action is known when called, and is not 0 to 13.
        """
        del key
        state, transition = self.transition(state, action)
        return (
            self.observe(state),
            state,
            transition.reward,
            transition.terminated,
            transition.truncated,
            transition.info,
        )

    def transition(self, state: EnvState, action: jax.Array | int) -> tuple[EnvState, Transition]:
        """Advances by one iteration without drawing an observation; see `step`."""
        _check_action(action)
        config = self.config
        action = jnp.asarray(action, jnp.int32)
        ctrl = apply_action(self.ids, state.ctrl, action, config.degrees_per_action)
        physics = self.physics.step(state.physics, ctrl)
        after = self._situation(physics.poses, ctrl)
        after = dataclasses.replace(after, grasped=after.grasped & ~physics.diverged)
        success = after.grasped & (after.height >= config.lift)
        before = self._situation(state.physics.poses, state.ctrl)
        terms = reward_terms(config.reward, before, after, success, config.lift)
        state = dataclasses.replace(
            state, physics=physics, ctrl=ctrl, step=state.step + 1, success=success
        )
        info = {
            "grasped": after.grasped,
            "success": success,
            "diverged": physics.diverged,
            "height": after.height,
            "distance": after.distance,
            **{f"reward_{name}": term for name, term in terms.items()},
        }
        too_long = state.step >= config.max_steps
        return state, Transition(
            reward=sum(terms.values(), start=jnp.zeros((), jnp.float32)),
            terminated=success,
            truncated=(too_long | physics.diverged) & ~success,
            info=info,
        )

    def _situation(self, poses: Poses, ctrl: jax.Array) -> Situation:
        ids = self.ids
        cube = poses.geom_xpos[ids.cube_geom]
        return Situation(
            distance=jnp.sqrt(jnp.sum(jnp.square(poses.site_xpos[ids.grasp_site] - cube))),
            height=cube[2] - np.float32(ids.cube_half_size),
            grasped=grasped(self.scene.mj_model, ids, poses, ctrl),
        )

    def observe(self, state: EnvState) -> Observation:
        """What the agent sees of a state.

        Returns:
          By `config.observation`: `"rgb"` `[H, W, 3] uint8`; `"rgbd"` a dict of that and `"depth"`
          `[H, W] float32`, m, infinite where nothing is hit; `"segmentation"` `[H, W] int32`, geom
          ids, -1 where nothing is hit; `"packed"` `[H, W] uint32`; `"state"` `[21] float32`: the
          arm's joints (rad), finger opening and gripper command (m), the gripper's and the cube's
          position, the cube's quaternion, and the way from gripper to cube (m).
        """
        kind = self.config.observation
        poses = state.physics.poses
        if kind == "state":
            return self._features(state)
        image: Any = self.render(poses.geom_xpos, poses.geom_xmat)
        if kind == "rgb":
            return rgb(image)
        if kind == "segmentation":
            return segmentation(image)
        if kind == "rgbd":
            return {"rgb": rgb(image[0]), "depth": image[1]}
        return image

    def _features(self, state: EnvState) -> jax.Array:
        ids, qpos = self.ids, state.physics.qpos
        gripper = state.physics.poses.site_xpos[ids.grasp_site]
        cube = qpos[ids.cube_qpos : ids.cube_qpos + 7]
        opening = jnp.mean(qpos[ids.finger_qpos], keepdims=True)
        command = state.ctrl[ids.gripper_ctrl][None]
        way = cube[:3] - gripper
        return jnp.concatenate([qpos[ids.arm_qpos], opening, command, gripper, cube, way])

    def _start(self, key: jax.Array, cube_place: jax.Array, needed: jax.Array | bool) -> EnvState:
        qpos, ctrl, draws = self.starts.draw(key, cube_place, needed)
        return EnvState(
            physics=self.physics.init(qpos, ctrl),
            ctrl=ctrl,
            step=jnp.zeros((), jnp.int32),
            cube_place=cube_place,
            success=jnp.zeros((), jnp.bool_),
            start_draws=draws,
        )


def make(name: str = "A", **options: Any) -> Env:
    """Makes environment `"A"` or `"B"` of James & Johns 2016.

    Args:
      name: `"A"`, everything constant, or `"B"`, joints and cube varied.
      **options: fields of `EnvConfig`, such as `physics`, `observation`, `size`, `reward`.

    Returns:
      The environment.

    Raises:
      ValueError: unknown environment or option, a value out of its domain, or a scene without the
        names that the task needs.
    """
    return make_env(env_config(name, **options))


def make_env(config: EnvConfig) -> Env:
    """Makes the environment of a configuration; see `make`."""
    scene = load_scene(config.scene)
    ids = resolve_task(scene)
    return Env(
        config=config,
        scene=scene,
        ids=ids,
        physics=make_physics(
            scene.mj_model,
            config.physics,
            substeps=ids.substeps,
            mjx_iterations=tuple(ids.mjx_iterations),
        ),
        starts=Starts(scene, ids, config),
        render=make_renderer(
            scene,
            camera=config.camera,
            size=config.size,
            shadows=config.shadows,
            depth=config.observation == "rgbd",
        ),
    )


def _check_action(action: jax.Array | int) -> None:
    if isinstance(action, jax.core.Tracer):
        return
    values = np.asarray(action)
    if not np.issubdtype(values.dtype, np.integer) or values.shape != ():
        raise ValueError(f"action is {action}: give one integer from 0 to {NUM_ACTIONS - 1}")
    if not 0 <= int(values) < NUM_ACTIONS:
        raise ValueError(f"action is {int(values)}: give an integer from 0 to {NUM_ACTIONS - 1}")
