"""Episodes of an agent with every step recorded, counted as the evaluation counts them."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from mjx_arm.algos.collect import act
from mjx_arm.algos.exploration import check_epsilon
from mjx_arm.envs.auto_reset import AutoReset, AutoResetState
from mjx_arm.envs.env import Env
from mjx_arm.options import Count, check_value
from mjx_arm.physics import compiler_options
from mjx_arm.training.evaluate import MAX_ENVS, Apply
from mjx_arm.varies import Params

# Steps of one compiled call.
_CHUNK = 100
# What the task `lift` measures.
MEASURED = ("grasped", "height", "distance")


@dataclasses.dataclass(frozen=True, eq=False)
class Rollout:
    """One episode of `L` steps.

    Attributes:
      qpos: `[L + 1, nq] float32`, before each step and after the last.
      action: `[L] int`, what was carried out.
      greedy: `[L] int`, the action with the largest Q-value.
      max_q: `[L] float32`, the largest Q-value before each step.
      grasped: `[L] bool`, after each step.
      height: `[L] float32`, of the cube above its rest after each step, m.
      distance: `[L] float32`, from the grasp site to the cube's centre after each step, m.
      success: the episode ended in success.
      diverged: the simulation diverged.
      params: values of the model's fields that vary by episode.
    """

    qpos: np.ndarray
    action: np.ndarray
    greedy: np.ndarray
    max_q: np.ndarray
    grasped: np.ndarray
    height: np.ndarray
    distance: np.ndarray
    success: bool
    diverged: bool
    params: Params

    def __len__(self) -> int:
        """Number of steps."""
        return len(self.action)


@flax.struct.dataclass
class _Run:
    envs: AutoResetState
    obs: Any
    key: jax.Array
    left: jax.Array


def roll_out(
    env: Env, apply: Apply, params: Any, *, episodes: int, epsilon: float, key: jax.Array
) -> list[Rollout]:
    """Runs an epsilon-greedy policy, and records every step.

    Starts, random actions and the number of episodes of each environment are those of
    `training.evaluate.evaluate` with the same key on one device. The first `min(episodes, 200)` of
    the result are the first episodes of all environments, so any number of them from the front is
    a sample that does not favour short episodes.

    Args:
      env: of the task `lift`, made with the observation that the network wants.
      apply: `(params, obs [N, ...]) -> Q-values [N, A]`.
      params: of the network.
      episodes: number of episodes.
      epsilon: share of random actions.
      key: consumed.

    Returns:
      The episodes, the first ones of all environments before the second ones.

    Raises:
      ValueError: another task, `episodes` below 1, or `epsilon` outside 0 to 1.
    """
    check_value("episodes", Count, episodes)
    check_epsilon(epsilon)
    if env.config.task != "lift":
        raise ValueError(f"rollouts are recorded of the task 'lift', got {env.config.task!r}")
    auto, num_envs = AutoReset(env), min(episodes, MAX_ENVS)
    quota = np.full(num_envs, episodes // num_envs)
    quota[: episodes % num_envs] += 1

    def record_chunk(params: Any, epsilon: jax.Array, run: _Run) -> tuple[_Run, dict[str, Any]]:
        step = functools.partial(_step, auto, apply, params, epsilon)
        return jax.lax.scan(step, run, None, _CHUNK)

    # All agents and epsilons share one program per environment, so a compilation cache finds it.
    advance = jax.jit(record_chunk, compiler_options=compiler_options(env.physics))
    run = jax.jit(functools.partial(_start, auto))(key, jnp.asarray(quota, jnp.int32))
    chunks = []
    while int(jnp.max(run.left)) > 0:
        run, chunk = advance(params, jnp.float32(epsilon), run)
        chunks.append(jax.device_get(chunk))
    steps = jax.tree.map(lambda *parts: np.concatenate(parts), *chunks)
    return _split(steps, quota)


def _start(auto: AutoReset, key: jax.Array, quota: jax.Array) -> _Run:
    reset_key, key = jax.random.split(key)
    obs, envs = jax.vmap(auto.reset)(jax.random.split(reset_key, len(quota)))
    return _Run(envs, obs, key, quota)


def _step(
    auto: AutoReset, apply: Apply, params: Any, epsilon: jax.Array, run: _Run, _: None
) -> tuple[_Run, dict[str, Any]]:
    key, act_key = jax.random.split(run.key)
    q = apply(params, run.obs)
    action, envs, transition = act(auto, act_key, run.envs, q, epsilon)
    reset = transition.info["reset"]
    record = {
        "qpos": run.envs.env.physics.qpos,
        "params": run.envs.env.params,
        "action": action.astype(jnp.int8),
        "greedy": jnp.argmax(q, axis=-1).astype(jnp.int8),
        "max_q": jnp.max(q, axis=-1),
        "success": transition.terminated,
        "diverged": transition.info["diverged"],
        "reset": reset,
        **{name: transition.metrics[name] for name in MEASURED},
    }
    obs: Any = jax.vmap(auto.env.observe)(envs.env)
    # Counted when the step after the last one is recorded: its qpos is the last of the episode.
    left = run.left - (reset & (run.left > 0)).astype(jnp.int32)
    return _Run(envs, obs, key, left), record


def _split(steps: dict[str, Any], quota: np.ndarray) -> list[Rollout]:
    """The episodes in steps `[T, N, ...]`: all first ones, then all second ones, and so on."""
    found: list[tuple[int, int, Rollout]] = []
    for column, wanted in enumerate(quota):
        ends = np.flatnonzero(steps["reset"][:, column])[:wanted]
        start = 0
        for number, end in enumerate(ends):
            found.append((number, column, _rollout(steps, column, start, int(end))))
            start = int(end) + 1
    return [rollout for _, _, rollout in sorted(found, key=lambda each: each[:2])]


def _rollout(steps: dict[str, Any], column: int, start: int, end: int) -> Rollout:
    own = {
        name: steps[name][start:end, column]
        for name in ("action", "greedy", "max_q", "grasped", "height", "distance")
    }
    return Rollout(
        **own,
        qpos=steps["qpos"][start : end + 1, column],
        success=bool(steps["success"][end - 1, column]),
        diverged=bool(steps["diverged"][end - 1, column]),
        params=jax.tree.map(lambda x: x[start, column], steps["params"]),
    )
