"""Rollouts that several tests look at."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from mjx_arm.env import Env, EnvState
from mjx_arm.physics import compiler_options
from mjx_arm.task import CLOSE, NUM_ACTIONS, OPEN

Policy = Callable[[jax.Array, EnvState], jax.Array]


def rollout(env: Env, policy: Policy, *, num_envs: int, length: int, seed: int):
    """Runs `policy(key, state)` without resets; returns states and transitions `[length, N]`."""
    reset_key, key = jax.random.split(jax.random.key(seed))
    start = jax.jit(jax.vmap(env.reset))(jax.random.split(reset_key, num_envs))[1]

    def step(state, key):
        action = jax.vmap(policy)(jax.random.split(key, num_envs), state)
        state, transition = jax.vmap(env.transition)(state, action)
        return state, (state, transition)

    keys = jax.random.split(key, length)
    run = jax.jit(
        lambda s, k: jax.lax.scan(step, s, k), compiler_options=compiler_options(env.physics)
    )
    _, (states, transitions) = run(start, keys)
    return jax.device_get(states), jax.device_get(transitions)


def succeeded(transitions) -> np.ndarray:
    """Which of the environments had a success at some step: `[N] bool`."""
    return transitions.terminated.any(axis=0)


def random_policy(key: jax.Array, state: EnvState) -> jax.Array:
    del state
    return jax.random.randint(key, (), 0, NUM_ACTIONS)


def make_pushing_policy(scripted: Callable[[EnvState], jax.Array]) -> Policy:
    """Goes for the cube, but opens, shuts and turns at random on the way, which pushes it about."""

    def policy(key: jax.Array, state: EnvState) -> jax.Array:
        choose, which = jax.random.split(key)
        draw = jax.random.uniform(choose)
        gripper = jax.random.choice(which, jnp.asarray([OPEN, CLOSE, CLOSE], jnp.int32))
        turn = jax.random.randint(which, (), 0, OPEN)
        return jnp.where(draw < 0.05, gripper, jnp.where(draw < 0.4, turn, scripted(state)))

    return policy
