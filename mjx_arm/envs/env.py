"""The environment: reset, step and observe, pure and for a single environment.

`env.step` never resets; `mjx_arm.envs.auto_reset` does.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np

from mjx_arm.envs.arm import Arm, apply_action, arm_feature_scales, arm_features, resolve_arm
from mjx_arm.envs.collision import Collision, make_self_collision
from mjx_arm.envs.config import EnvConfig, env_config
from mjx_arm.envs.randomisation import Randomiser, image_varies, make_randomiser, select_rows
from mjx_arm.envs.starts import StartSampler
from mjx_arm.envs.state import EnvState, Observation, Placement, Snapshot, Transition
from mjx_arm.envs.tasks import find_task
from mjx_arm.envs.tasks.base import Reward, SizedTask, Task
from mjx_arm.kinematics import Kinematics, Poses, make_camera_pose, make_kinematics
from mjx_arm.options import check_name
from mjx_arm.physics import Physics, make_physics
from mjx_arm.references import is_of_package, is_reference, load_reference, reference_to
from mjx_arm.render import make_renderer, rgb, segmentation
from mjx_arm.render.materialize import materialize
from mjx_arm.render.sensor import entropy_of, make_sensor
from mjx_arm.scene import Scene, SceneSource, compile_scene, load_scene
from mjx_arm.varies import Params, Varies, check_varies, merge_params, merge_varies

# `(qpos, poses, params)` -> packed pixels, and with depth the z-depth.
Camera = Callable[[jax.Array, Poses, Params], tuple[jax.Array, ...]]
# What splits the key of a start is older than randomisation, which may not change it.
_RANDOMISATION = 17


@dataclasses.dataclass(frozen=True, eq=False)
class Env:
    """A robot arm with a task; made by `mjx_arm.make`.

    Attributes:
      config: the options.
      scene: the compiled scene.
      arm: the arm in it.
      task: the task.
      reward: computes the terms of the reward.
      physics: the backend's functions.
      starts: samples the starts of episodes.
      collision: whether the arm is free of itself, its base and the ground.
      link_kinematics: poses of the geoms of `collision` alone, at a `qpos` and params.
      varies: which rows of the model's fields vary by episode.
      randomiser: samples what varies beside the task's own params.
      image_varies: the part of `varies` that images are made from.
      image_kinematics: poses at a `qpos` and the params of `image_varies`.
      cameras: renders the image of each camera.
    """

    config: EnvConfig
    scene: Scene
    arm: Arm
    task: Task
    reward: Reward
    physics: Physics
    starts: StartSampler
    collision: Collision
    link_kinematics: Kinematics
    varies: Varies
    randomiser: Randomiser
    image_varies: Varies
    image_kinematics: Kinematics
    cameras: tuple[Camera, ...]

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickles how to make the environment: compiled functions have no other form."""
        reward = self.reward if is_reference(self.config.reward) else None
        return _remake, (self.config, reward, self.scene.name, self.scene.source)

    @property
    def num_actions(self) -> int:
        """Number of discrete actions."""
        return self.arm.num_actions

    @property
    def feature_scales(self) -> tuple[float, ...]:
        """Factors that bring the state features to a size of about 1."""
        return (*arm_feature_scales(self.arm), *self.task.feature_scales)

    def reset(self, key: jax.Array) -> tuple[Observation, EnvState]:
        """Starts an episode that owes nothing to an earlier one. Consumes the key.

        Returns:
          The observation and the state.
        """
        placement_key, start_key = jax.random.split(key)
        state = self._start(start_key, self._sample_placement(placement_key), True)
        return self.observe(state), state

    def restart(self, key: jax.Array, state: EnvState, wanted: jax.Array | bool = True) -> EnvState:
        """Starts the next episode, with what outlives the last one. Consumes the key.

        Args:
          key: a PRNG key.
          state: the last state of the episode that has ended.
          wanted: `[] bool`; where false the result means nothing, and costs less.

        Returns:
          The state that the next episode starts from.
        """
        placement_key, start_key = jax.random.split(key)
        placement = self._sample_placement(placement_key)
        if self.config.placed == "after_success":
            placement = jax.tree.map(
                lambda new, old: jnp.where(state.success, new, old), placement, state.placement
            )
        return self._start(start_key, placement, wanted, state.past.get("age"))

    def step(
        self, key: jax.Array, state: EnvState, action: jax.Array | int
    ) -> tuple[Observation, EnvState, jax.Array, jax.Array, jax.Array, dict[str, jax.Array]]:
        """Advances by one iteration; never resets.

        Args:
          key: not consumed, the physics being deterministic; there for the common interface.
          state: the state before.
          action: `[] int32`, 0 to `num_actions - 1`.

        Returns:
          observation, state, reward, terminated, truncated and info. `info` has the task's
          metrics (for `lift`: `grasped`, `height`, `distance`), `success`, `diverged`, `blocked`
          (the action was not carried out, because the arm would touch itself, its base or the
          ground), and the terms of the reward, `reward_*`.

        Raises:
          ValueError: the action is known when called, and is not one of the actions.
        """
        del key
        state, transition = self.transition(state, action)
        return (
            self.observe(state),
            state,
            transition.reward,
            transition.terminated,
            transition.truncated,
            transition.metrics | transition.info,
        )

    def transition(self, state: EnvState, action: jax.Array | int) -> tuple[EnvState, Transition]:
        """Advances by one iteration without rendering an observation; see `step`."""
        self._check_action(action)
        config, task = self.config, self._task_of(self.varies, state.params)
        action = jnp.asarray(action, jnp.int32)
        wanted = self._commanded(state, action)
        blocked = self.is_blocked(state.physics.qpos, state.ctrl, wanted, state.params)
        ctrl = jnp.where(blocked, state.ctrl, wanted)
        physics = self.physics.step(state.physics, ctrl, state.params)
        after = dataclasses.replace(state, physics=physics, ctrl=ctrl, step=state.step + 1)
        if state.past:
            after = dataclasses.replace(after, past=_advance_past(state, action))
        then = Snapshot(after, task.measure(after))
        terms = self.reward(Snapshot(state, task.measure(state)), then, action)
        terms = {name: config.reward_scale * term for name, term in terms.items()}
        success = then.measured["success"]
        info = {
            "success": success,
            "diverged": physics.diverged,
            "blocked": blocked,
            **{f"reward_{name}": term for name, term in terms.items()},
        }
        too_long = after.step >= config.max_steps
        return dataclasses.replace(after, success=success), Transition(
            reward=sum(terms.values(), start=jnp.zeros((), jnp.float32)),
            terminated=success,
            truncated=(too_long | physics.diverged) & ~success,
            metrics={name: x for name, x in then.measured.items() if name != "success"},
            info=info,
        )

    def observe(self, state: EnvState) -> Observation:
        """What the agent sees of a state.

        Returns:
          By `config.observation`: `"rgb"` `[H, W, 3] uint8`; `"rgbd"` a dict of that and `"depth"`
          `[H, W] float32`, m, infinite where nothing is hit; `"segmentation"` `[H, W] int32`, geom
          ids, -1 where nothing is hit; `"packed"` `[H, W] uint32`; `"state"` `[F] float32`, the
          state features. With several cameras images have a leading axis of cameras.
        """
        kind = self.config.observation
        if kind == "state":
            return self.features(state)
        image = self.image(state)
        if kind == "rgb":
            return rgb(image[0])
        if kind == "segmentation":
            return segmentation(image[0])
        if kind == "rgbd":
            return {"rgb": rgb(image[0]), "depth": image[1]}
        return image[0]

    def image(self, state: EnvState) -> tuple[jax.Array, ...]:
        """What the camera shows of a state, an earlier one if images are delayed; see `render`."""
        if self.randomiser:
            return self.look(self.shown_qpos(state), self.image_params(state.params))
        return self.render(state.physics.qpos, state.physics.poses, state.params)

    def render(self, qpos: jax.Array, poses: Poses, params: Params) -> tuple[jax.Array, ...]:
        """Packed pixels `[H, W] uint32`, and for `"rgbd"` the depth; see `observe`."""
        return self._shoot(qpos, poses, self.image_params(params))

    def look(self, qpos: jax.Array, params: Params) -> tuple[jax.Array, ...]:
        """The image of a state and the params of `image_varies`, which the replay stores.

        With randomisation, whoever renders the same two gets the same image to the bit.
        """
        poses = self.image_kinematics(qpos, params)
        if self.randomiser:
            # Or XLA on CPU would compute poses in each kernel, and round them in each its own way.
            poses = jax.tree.map(lambda x: jax.lax.reduce_precision(x, 8, 23), poses)
        return self._shoot(qpos, poses, params)

    def image_params(self, params: Params) -> Params:
        """Of the params of an episode those of `image_varies`."""
        return select_rows(self.varies, params, self.image_varies) if self.randomiser else params

    def shown_qpos(self, state: EnvState) -> jax.Array:
        """The `qpos [nq] float32` that the image of a state shows: an earlier one, if delayed."""
        if "qpos" not in state.past:
            return state.physics.qpos
        delay = state.params["image_delay"][0]
        shown = state.physics.qpos
        for steps, earlier in enumerate(state.past["qpos"], start=1):
            shown = jnp.where(delay >= steps, earlier, shown)
        return shown

    def _shoot(self, qpos: jax.Array, poses: Poses, params: Params) -> tuple[jax.Array, ...]:
        images = [camera(qpos, poses, params) for camera in self.cameras]
        if len(images) == 1:
            return images[0]
        return tuple(jnp.stack(arrays) for arrays in zip(*images, strict=True))

    def with_cameras(self, **options: Any) -> Env:
        """The same environment with other images, such as `size=(256, 256), shadows=True`."""
        config = dataclasses.replace(self.config, **options)
        cameras = _make_cameras(self.scene, config, self.image_varies)
        return dataclasses.replace(self, config=config, cameras=cameras)

    def features(self, state: EnvState) -> jax.Array:
        """State features, `[F] float32`: those of `arm_features`, then the task's."""
        site = state.physics.poses.site_xpos[self.arm.grasp_site]
        arm = arm_features(self.arm, state.physics.qpos, state.ctrl, site)
        task = self._task_of(self.varies, state.params)
        return jnp.concatenate([arm, task.features(state)])

    def _sample_placement(self, key: jax.Array) -> Placement:
        if self.config.placed == "fixed":
            return self.task.fixed_placement()
        return self.task.sample_placement(key)

    def _start(
        self,
        key: jax.Array,
        placement: Placement,
        wanted: jax.Array | bool,
        age: jax.Array | None = None,
    ) -> EnvState:
        starts = self.starts
        if self.randomiser:
            age = jnp.zeros((), jnp.int32) if age is None else age
            starts = self._randomised_starts(jax.random.fold_in(key, _RANDOMISATION), age)
        qpos, ctrl, params, samples = starts.sample(key, placement, wanted)
        return EnvState(
            physics=self.physics.init(qpos, ctrl, params),
            ctrl=ctrl,
            step=jnp.zeros((), jnp.int32),
            params=params,
            placement=placement,
            success=jnp.zeros((), jnp.bool_),
            start_samples=samples,
            past=self._first_past(qpos, age),
        )

    def _randomised_starts(self, key: jax.Array, age: jax.Array) -> StartSampler:
        """The sampler of starts with what else varies. Consumes the key."""
        randomiser, own = self.randomiser, self.task.varies
        growth = randomiser.growth(age) if randomiser.growth_steps else 1.0
        params = randomiser.sample(key, growth)
        return dataclasses.replace(
            self.starts,
            task=self._task_of(randomiser.varies, params),
            add_params=lambda given: merge_params(own, given, randomiser.varies, params),
        )

    def _first_past(self, qpos: jax.Array, age: jax.Array | None) -> dict[str, jax.Array]:
        """`EnvState.past` at the start of an episode, as if the arm had long been there."""
        past, randomiser = {}, self.randomiser
        if "image_delay" in randomiser.varies:
            past["qpos"] = jnp.tile(qpos, (randomiser.ranges.image_delay, 1))
        if "action_delay" in randomiser.varies:
            past["actions"] = jnp.full((randomiser.ranges.action_delay,), -1, jnp.int32)
        if randomiser.growth_steps:
            assert age is not None
            past["age"] = age
        return past

    def _task_of(self, varies: Varies, params: Params) -> Task:
        """The task, with the sizes that its objects have in an episode."""
        if not self.randomiser.resizes:
            return self.task
        return cast(SizedTask, self.task).with_params(varies, params)

    def _commanded(self, state: EnvState, action: jax.Array) -> jax.Array:
        """The targets `[nu] float32` that an action asks for, or a delayed one before it."""
        config = self.config
        delayed = "actions" in state.past
        if delayed:
            delay = state.params["action_delay"][0]
            for steps, earlier in enumerate(state.past["actions"], start=1):
                action = jnp.where(delay >= steps, earlier, action)
        wanted = apply_action(
            self.arm, state.ctrl, action, config.degrees_per_action, config.millimetres_per_action
        )
        return jnp.where(action < 0, state.ctrl, wanted) if delayed else wanted

    def is_blocked(
        self, qpos: jax.Array, ctrl: jax.Array, wanted: jax.Array, params: Params
    ) -> jax.Array:
        """Whether a command would take the arm into itself, its base or the ground: `[] bool`.

        Args:
          qpos: `[nq] float32`, the present state; of it only what no servo of the arm's joints
            moves is used, such as the fingers.
          ctrl: `[nu] float32`, the last command.
          wanted: `[nu] float32`, the command.
          params: of the episode.
        """
        before, after = (self.arm.commanded(qpos, command) for command in (ctrl, wanted))
        return self.collision.is_blocked(
            (before, params),
            self.link_kinematics(after, params),
            lambda last: self.link_kinematics(*last),
        )

    def _check_action(self, action: jax.Array | int) -> None:
        if isinstance(action, jax.core.Tracer):
            return
        values, last = np.asarray(action), self.num_actions - 1
        whole = np.issubdtype(values.dtype, np.integer) and values.shape == ()
        if not whole or not 0 <= int(values) <= last:
            raise ValueError(f"action must be one whole number from 0 to {last}, got {action}")


def make(env: str = "A", *, reward: str | Reward = "", **options: Any) -> Env:
    """Makes environment `"A"` or `"B"` of a task.

    Args:
      env: `"A"`, everything constant, or `"B"`, joints and objects varied.
      reward: a reward of the task by name, `"module:function"`, or a function
        `reward(before, after, action)` of two `Snapshot` and the action, `[] int32`, that returns
        named terms, each `[] float32`.
      **options: fields of `EnvConfig` and of the task's own options, such as `task`, `physics`,
        `observation`, `size`.

    Returns:
      The environment.

    Raises:
      ValueError: an unknown option, a value that an option does not take, or a scene that does not
        have what arm and task need.
    """
    if callable(reward):
        config = env_config(env, reward=reference_to(reward), **options)
        return make_env(config, reward=reward)
    return make_env(env_config(env, reward=reward, **options))


def make_env(config: EnvConfig, *, reward: Reward | None = None, scene: Scene | None = None) -> Env:
    """Makes the environment of a configuration; see `make`.

    Args:
      config: the options.
      reward: the function that `config.reward` names; by default it is imported.
      scene: the scene that `config.scene` names; by default it is read from its files.
    """
    scene = load_scene(config.scene_name) if scene is None else scene
    arm = resolve_arm(scene)
    task = find_task(config.task).make(config.task_options, scene, arm)
    model = scene.mj_model
    check_varies(model, task.varies)
    randomiser = make_randomiser(config.randomise, model, config.cameras)
    if randomiser.resizes and not hasattr(task, "with_params"):
        raise ValueError(
            f"task {config.task!r} has no method with_params(varies, params), so it would take "
            "objects that vary in size for those of the scene: write one, or give cube_size 1 1"
        )
    varies = merge_varies(task.varies, randomiser.varies) if randomiser else task.varies
    shown = image_varies(model, varies) if randomiser else varies
    kinematics = make_kinematics(model, varies)
    reward = _find_reward(config, task) if reward is None else reward
    # Geoms whose place the task varies mark a place; the arm may pass through them.
    marks = task.varies.get("geom_pos", ())
    largest = randomiser.ranges.cube_size[1]
    obstacles = [dataclasses.replace(x, radius=x.radius * largest) for x in task.obstacles]
    collision = make_self_collision(model, ignored=marks, home=arm.home_qpos)
    around = make_self_collision(model, obstacles=obstacles, ignored=marks, home=arm.home_qpos)
    env = Env(
        config=config,
        scene=scene,
        arm=arm,
        task=task,
        reward=reward,
        physics=make_physics(
            model,
            config.physics,
            substeps=scene.substeps,
            mjx_iterations=scene.mjx_iterations,
            varies=varies,
        ),
        starts=StartSampler(arm, task, around, kinematics, config),
        collision=collision,
        link_kinematics=make_kinematics(model, varies, collision.geoms.tolist()),
        varies=varies,
        randomiser=randomiser,
        image_varies=shown,
        image_kinematics=make_kinematics(model, shown) if randomiser else kinematics,
        cameras=_make_cameras(scene, config, shown),
    )
    if not is_of_package(type(task)):
        _check_measures(env)
    if is_reference(config.reward) or not is_of_package(reward):
        _check_reward(env)
    return env


def _remake(config: EnvConfig, reward: Reward | None, name: str, source: SceneSource) -> Env:
    """An environment that was pickled."""
    return make_env(config, reward=reward, scene=compile_scene(name, source))


# What a run writes under these names beside what a task measures.
_TAKEN = ("length", "reward", "max_q", "blocked")


def _check_measures(env: Env) -> None:
    """Rejects what a task of the user's measures, where a run could not count it."""
    name = f"the task {env.config.task!r}"

    def check(key: jax.Array) -> Any:
        return env.task.measure(env._start(key, env._sample_placement(key), True))

    measured = jax.eval_shape(check, jax.random.key(0))
    if "success" not in measured:
        raise ValueError(f"{name} must measure 'success', got {sorted(measured)}")
    for metric, value in measured.items():
        said = f"{list(value.shape)} {value.dtype}"
        if said not in ("[] bool", "[] float32"):
            raise ValueError(f"{name}: {metric!r} must be [] bool or [] float32, got {said}")
        if metric in _TAKEN:
            raise ValueError(f"{name}: a run counts {metric!r} itself, give it another name")
    if measured["success"].dtype != jnp.bool_:
        raise ValueError(f"{name}: 'success' must be [] bool, got [] float32")


def _check_reward(env: Env) -> None:
    """Rejects a reward that does not return a dict of named `[] float32` terms.

    Those of the shipped tasks have tests instead: to trace a start takes a moment.
    """
    name = f"the reward {reference_to(env.reward)!r}"
    if not callable(env.reward):
        raise ValueError(
            f"the reward {env.config.reward!r} must be a function (before, after, action), "
            f"got {type(env.reward).__name__}"
        )

    def check(key: jax.Array) -> None:
        state = env._start(key, env._sample_placement(key), True)
        snapshot = Snapshot(state, env.task.measure(state))
        try:
            terms: Any = env.reward(snapshot, snapshot, jnp.zeros((), jnp.int32))
        except Exception as error:  # whatever a user's function raises
            reason = (str(error).splitlines() or [""])[0]
            raise ValueError(
                f"{name} fails when called with (before, after, action): "
                f"{type(error).__name__}: {reason}"
            ) from error
        if not isinstance(terms, dict):
            raise ValueError(
                f"{name} must return a dict of named terms, each [] float32, "
                f"got {type(terms).__name__}"
            )
        for term, value in terms.items():
            _check_term(name, term, value)

    jax.eval_shape(check, jax.random.key(0))


def _check_term(name: str, term: Any, value: Any) -> None:
    if not isinstance(term, str):
        raise ValueError(f"{name} must name its terms by text, got {term!r}")
    try:
        found = jax.eval_shape(lambda: value)
        said = f"{list(found.shape)} {found.dtype}"
    except (TypeError, AttributeError):
        said = type(value).__name__
    if said != "[] float32":
        raise ValueError(f"{name}: the term {term!r} must be [] float32, got {said}")


def _find_reward(config: EnvConfig, task: Task) -> Reward:
    if is_reference(config.reward):
        reward: Reward = load_reference(config.reward, "reward")
        return reward
    name = config.reward or next(iter(task.rewards))
    check_name("reward", name, task.rewards)
    return task.rewards[name]


def _advance_past(state: EnvState, action: jax.Array) -> dict[str, jax.Array]:
    """`EnvState.past` one step later: the newest first, the oldest dropped."""
    past = dict(state.past)
    if "qpos" in past:
        past["qpos"] = jnp.concatenate([state.physics.qpos[None], past["qpos"][:-1]])
    if "actions" in past:
        past["actions"] = jnp.concatenate([action[None], past["actions"][:-1]])
    if "age" in past:
        past["age"] = past["age"] + 1
    return past


def _make_cameras(scene: Scene, config: EnvConfig, varies: Varies) -> tuple[Camera, ...]:
    return tuple(
        _make_camera(scene, name, number, config, varies)
        for number, name in enumerate(config.cameras)
    )


def _make_camera(scene: Scene, name: str, number: int, config: EnvConfig, varies: Varies) -> Camera:
    """Renders what one camera sees; a camera on a moving body is moved with it."""
    render: Any = make_renderer(
        scene,
        camera=name,
        size=config.size,
        shadows=config.shadows,
        samples=config.samples,
        depth=config.observation == "rgbd",
        varies=varies,
    )
    pose = None
    if scene.mj_model.body_weldid[scene.mj_model.camera(name).bodyid[0]] != 0:
        pose = make_camera_pose(scene.mj_model, name, varies)
    sensor = make_sensor(varies)

    def camera(qpos: jax.Array, poses: Poses, params: Params) -> tuple[jax.Array, ...]:
        moved = None if pose is None else pose(qpos, params)
        image = render(poses.geom_xpos, poses.geom_xmat, params, moved)
        image = image if isinstance(image, tuple) else (image,)
        if sensor is None:
            return image
        packed = sensor(image[0], params, entropy_of(qpos, number))
        return materialize(packed, *image[1:])

    return camera
