"""The environments as gymnasium's `Env` and `VectorEnv`; numpy outside, one jitted call a step."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.vector import AutoresetMode

from mjx_arm.envs.auto_reset import AutoReset
from mjx_arm.envs.env import Env, make
from mjx_arm.envs.state import EnvState
from mjx_arm.options import Count, check_value
from mjx_arm.physics import compiler_options

# Edge of the images of `render`, pixels, and how many of them make a second of video.
_EDGE = 256
_FPS = 30
# The process that imported jax; a fork of it has none of the threads that jax waits for.
_PROCESS = os.getpid()
_MODES = {"next_step": AutoresetMode.NEXT_STEP, "same_step": AutoresetMode.SAME_STEP}


def observation_space(env: Env) -> gymnasium.Space[Any]:
    """Space of a single environment's observations."""
    kind = env.config.observation
    cameras = () if len(env.cameras) == 1 else (len(env.cameras),)
    size = (*cameras, *env.config.size)
    image = gymnasium.spaces.Box(0, 255, (*size, 3), np.uint8)
    if kind == "rgb":
        return image
    if kind == "rgbd":
        depth = gymnasium.spaces.Box(0.0, np.inf, size, np.float32)
        return gymnasium.spaces.Dict({"rgb": image, "depth": depth})
    if kind == "segmentation":
        return gymnasium.spaces.Box(-1, env.scene.mj_model.ngeom - 1, size, np.int32)
    if kind == "packed":
        return gymnasium.spaces.Box(0, 2**32 - 1, size, np.uint32)
    obs = jax.eval_shape(env.reset, jax.random.key(0))[0]
    assert isinstance(obs, jax.ShapeDtypeStruct)
    return gymnasium.spaces.Box(-np.inf, np.inf, obs.shape, np.float32)


def _jit(env: Env, function: Any) -> Any:
    return jax.jit(function, compiler_options=compiler_options(env.physics))


def _numpy(tree: Any) -> Any:
    # Copies, because the caller may keep and change them.
    return jax.tree.map(np.array, tree)


class ArmCubeEnv(gymnasium.Env[Any, np.int64]):
    """One environment with the interface of gymnasium.

    `reset` with a seed forgets all earlier episodes. `reset` without one starts the next episode,
    and keeps what outlives an episode: in environment B, the cube's place after a failure. Episodes
    are truncated after `max_steps`, so no `TimeLimit` is needed. `info` is that of `Env.step`.

    Args:
      name: environment, `"A"` or `"B"`.
      render_mode: None or `"rgb_array"`, an image of 256 by 256 pixels with shadows.
      **options: fields of `EnvConfig`, such as `observation` or `physics`.

    Raises:
      ValueError: unknown environment or option, or an invalid value.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": _FPS}  # noqa: RUF012

    def __init__(self, name: str = "A", render_mode: str | None = None, **options: Any):
        _check_process()
        _check_render_mode(render_mode)
        self.render_mode = render_mode
        self.env = make(name, **options)
        self.observation_space = observation_space(self.env)
        self.action_space = gymnasium.spaces.Discrete(self.env.num_actions)
        self._reset = _jit(self.env, self.env.reset)
        self._step = _jit(self.env, functools.partial(self.env.step, jax.random.key(0)))
        self._restart = _jit(self.env, self._next_episode)
        self._state: EnvState | None = None

    def _next_episode(self, key: jax.Array, state: EnvState) -> Any:
        state = self.env.restart(key, state)
        return self.env.observe(state), state

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Starts an episode. `options` are ignored."""
        super().reset(seed=seed)
        key = _sample_key(self.np_random)
        if seed is not None or self._state is None:
            obs, self._state = self._reset(key)
        else:
            obs, self._state = self._restart(key, self._state)
        return _numpy(obs), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Advances by one iteration.

        Raises:
          ValueError: the action is not a valid one, or `reset` was never called.
        """
        if self._state is None:
            raise ValueError("step before reset: call reset first")
        _check_actions(action, (), self.env.num_actions)
        obs, self._state, reward, terminated, truncated, info = self._step(
            self._state, jnp.int32(action)
        )
        flags = bool(terminated), bool(truncated)
        return _numpy(obs), float(reward), *flags, {k: v.item() for k, v in _numpy(info).items()}

    def render(self) -> Any:
        """An image `[256, 256, 3] uint8` of the scene, or None without a render mode."""
        if self.render_mode is None or self._state is None:
            return None
        return np.array(self._render_image(self._state))

    @functools.cached_property
    def _render_image(self) -> Any:
        return jax.jit(_make_image(self.env))


class ArmCubeVectorEnv(gymnasium.vector.VectorEnv[Any, Any, Any]):
    """Many environments that step in one jitted call; `gymnasium.make_vec` makes this class.

    With `autoreset="next_step"` (gymnasium's default) the step after the end of an episode ignores
    its action and returns the first observation of the next episode. With `"same_step"` the step
    that ends an episode returns that observation; the last observation of the old episode is then
    in `info["final_obs"]`, and its info in `info["final_info"]`.

    Args:
      name: environment, `"A"` or `"B"`.
      num_envs: number of environments.
      autoreset: `"next_step"` or `"same_step"`.
      render_mode: None or `"rgb_array"`, an image of each environment.
      **options: fields of `EnvConfig`.

    Raises:
      ValueError: unknown environment or option, or an invalid value.
    """

    def __init__(
        self,
        name: str = "A",
        num_envs: int = 1,
        autoreset: str = "next_step",
        render_mode: str | None = None,
        **options: Any,
    ):
        check_value("num_envs", Count, num_envs)
        _check_process()
        _check_render_mode(render_mode)
        self.render_mode = render_mode
        self.num_envs = num_envs
        self.env = make(name, **options)
        self._auto = AutoReset(self.env, autoreset)
        self.metadata = {**ArmCubeEnv.metadata, "autoreset_mode": _MODES[autoreset]}
        self.single_observation_space = observation_space(self.env)
        self.single_action_space = gymnasium.spaces.Discrete(self.env.num_actions)
        batch = gymnasium.vector.utils.batch_space
        self.observation_space = batch(self.single_observation_space, num_envs)
        self.action_space = batch(self.single_action_space, num_envs)
        self._reset = _jit(self.env, jax.vmap(self._auto.reset))
        self._step = _jit(self.env, jax.vmap(self._auto.step))
        self._observe = _jit(self.env, jax.vmap(lambda state: self.env.observe(state.env)))
        self._state: Any = None

    def _keys(self) -> jax.Array:
        return jax.random.split(_sample_key(self.np_random), self.num_envs)

    def reset(
        self, *, seed: int | list[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Starts an episode in every environment, as if it were its first.

        What outlives an episode does not outlive a reset: in B the cube gets a new place, and the
        ranges of a curriculum are the first ones again. At the end of an episode `step` goes on.

        Args:
          seed: one whole number for all environments.
          options: `{"reset_mask": [num_envs] bool}` restricts the reset to some environments.

        Raises:
          ValueError: `seed` is a list, or the mask does not fit.
        """
        if isinstance(seed, list):
            raise ValueError("seed must be one whole number for all environments, got a list")
        super().reset(seed=seed)
        obs, state = self._reset(self._keys())
        mask = (options or {}).get("reset_mask")
        if mask is not None:
            mask = np.asarray(mask)
            if mask.shape != (self.num_envs,) or mask.dtype != np.bool_:
                raise ValueError(f"reset_mask must be {self.num_envs} booleans, got {mask}")
            if self._state is not None:
                old = self._observe(self._state)
                obs, state = _where_first(mask, (obs, state), (old, self._state))
        self._state = state
        return _numpy(obs), {}

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Advances every environment by one iteration, or resets it.

        Raises:
          ValueError: an action is not a valid one, or `reset` was never called.
        """
        if self._state is None:
            raise ValueError("step before reset: call reset first")
        _check_actions(actions, (self.num_envs,), self.env.num_actions)
        obs, self._state, *rest, info = self._step(
            self._keys(), self._state, jnp.asarray(actions, jnp.int32)
        )
        reward, terminated, truncated = _numpy(rest)
        return _numpy(obs), reward, terminated, truncated, self._info(_numpy(info))

    def _info(self, info: dict[str, Any]) -> dict[str, Any]:
        """Adds gymnasium's masks: `_name` says for which environments `name` is valid."""
        reset = info.pop("reset")
        if self._auto.mode == "next_step":
            masked = dict.fromkeys(info, ~reset)
        else:
            final = info.pop("final_observation")
            masked = dict.fromkeys(info, np.ones(self.num_envs, np.bool_))
            if reset.any():
                last = dict(info) | {f"_{name}": reset for name in info}
                rows = [jax.tree.map(lambda x, i=i: x[i], final) for i in range(self.num_envs)]
                objects = np.empty(self.num_envs, object)
                for i in np.flatnonzero(reset):
                    objects[i] = rows[i]
                info |= {"final_obs": objects, "final_info": last}
                masked |= {"final_obs": reset, "final_info": reset}
        return info | {f"_{name}": mask for name, mask in masked.items()}

    def render(self) -> tuple[Any, ...] | None:
        """Images `[256, 256, 3] uint8` of all environments, or None without a render mode."""
        if self.render_mode is None or self._state is None:
            return None
        return tuple(np.array(self._render_image(self._state.env)))

    @functools.cached_property
    def _render_image(self) -> Any:
        return jax.jit(jax.vmap(_make_image(self.env)))


def _make_image(env: Env) -> Callable[[EnvState], jax.Array]:
    """Makes `state -> [256, 256, 3] uint8`, the image of the first camera."""
    first = env.with_cameras(
        camera=env.config.cameras[0], size=(_EDGE, _EDGE), shadows=True, observation="rgb"
    )
    return first.observe  # type: ignore[return-value]


def _check_actions(actions: Any, shape: tuple[int, ...], num_actions: int) -> None:
    values = np.asarray(actions)
    whole = np.issubdtype(values.dtype, np.integer) and values.shape == shape
    if not whole or not ((values >= 0) & (values < num_actions)).all():
        count = f"{shape[0]} whole numbers" if shape else "one whole number"
        raise ValueError(f"actions must be {count} from 0 to {num_actions - 1}, got {actions}")


def _where_first(mask: np.ndarray, new: Any, old: Any) -> Any:
    """Rows of `new` where the mask is true, else of `old`."""

    def choose(x: jax.Array, y: jax.Array) -> jax.Array:
        return jnp.where(mask.reshape(-1, *(1,) * (x.ndim - 1)), x, y)

    return jax.tree.map(choose, new, old)


def _sample_key(generator: np.random.Generator) -> jax.Array:
    return jax.random.key(generator.integers(2**32, dtype=np.uint32))


def _check_process() -> None:
    if os.getpid() != _PROCESS:
        raise ValueError(
            "this process was forked from one that runs jax, in which jax hangs: give "
            "AsyncVectorEnv context='spawn', or use ArmCubeVectorEnv, which steps all at once"
        )


def _check_render_mode(mode: str | None) -> None:
    if mode not in (None, "rgb_array"):
        raise ValueError(f"unknown render_mode {mode!r}: give None or 'rgb_array'")
