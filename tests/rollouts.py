"""Rollouts that several tests look at."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from mjx_arm.envs.arm import Arm
from mjx_arm.envs.env import Env
from mjx_arm.envs.state import EnvState
from mjx_arm.physics import compiler_options

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


def make_random_policy(arm: Arm) -> Policy:
    """Takes every action with the same probability."""

    def policy(key: jax.Array, state: EnvState) -> jax.Array:
        del state
        return jax.random.randint(key, (), 0, arm.num_actions)

    return policy


def make_pushing_policy(arm: Arm, scripted: Callable[[EnvState], jax.Array]) -> Policy:
    """Goes for the cube, but opens, closes and turns at random, which pushes the cube about."""

    def policy(key: jax.Array, state: EnvState) -> jax.Array:
        choose, which = jax.random.split(key)
        share = jax.random.uniform(choose)
        close, opened = arm.close_action, arm.open_action
        gripper = jax.random.choice(which, jnp.asarray([opened, close, close], jnp.int32))
        turn = jax.random.randint(which, (), 0, opened)
        return jnp.where(share < 0.05, gripper, jnp.where(share < 0.4, turn, scripted(state)))

    return policy
