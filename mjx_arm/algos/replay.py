"""Experience replay on the device: a ring of time steps of all environments, each frame once.

Slot `t` of environment `n` holds what the agent saw at time `t`, what it did, and what came of it;
what it saw next is in slot `t + 1`. With auto-reset in the next step, that also holds for the last
frame of an episode, and only the transition across the border is masked.
"""

from __future__ import annotations

import flax.struct
import jax
import jax.numpy as jnp


@flax.struct.dataclass
class Step:
    """One time step of all environments, as it is stored.

    Attributes:
      frame: pytree of `[N, ...]`, what an observation is made from when it is sampled.
      action: `[N] uint8`.
      reward: `[N] float32`.
      terminated: `[N] bool`.
      truncated: `[N] bool`.
      masked: `[N] bool`, no transition starts here: a reset, or a simulation that diverged.
    """

    frame: jax.Array
    action: jax.Array
    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    masked: jax.Array


@flax.struct.dataclass
class Replay:
    """The ring.

    Attributes:
      steps: a `Step` with a leading axis of `T` slots.
      count: `[] int32`, slots written since the beginning.
    """

    steps: Step
    count: jax.Array


@flax.struct.dataclass
class Batch:
    """Sampled n-step transitions.

    Attributes:
      frame: pytree of `[B, ...]`.
      action: `[B] int32`.
      reward: `[B] float32`, discounted sum over the steps that were taken.
      next_frame: pytree of `[B, ...]`, the frame to bootstrap from.
      discount: `[B] float32`, what its value is worth; 0 after a termination.
      weight: `[B] float32`, 0 for a masked transition, whose other numbers are 0 as well.
    """

    frame: jax.Array
    action: jax.Array
    reward: jax.Array
    next_frame: jax.Array
    discount: jax.Array
    weight: jax.Array


def init_replay(step: Step, slots: int) -> Replay:
    """Makes an empty ring.

    Args:
      step: any step, for shapes and dtypes.
      slots: time steps that the ring holds, for each environment.
    """
    empty = jax.tree.map(lambda x: jnp.zeros((slots, *x.shape), x.dtype), step)
    return Replay(steps=empty, count=jnp.zeros((), jnp.int32))


def add(replay: Replay, step: Step) -> Replay:
    """Writes one time step over the oldest; in place where the replay is donated."""
    slot = replay.count % replay.steps.reward.shape[0]
    steps = jax.tree.map(
        lambda ring, x: jax.lax.dynamic_update_index_in_dim(ring, x, slot, 0), replay.steps, step
    )
    return Replay(steps=steps, count=replay.count + 1)


def sample(replay: Replay, key: jax.Array, batch: int, n_step: int, gamma: float) -> Batch:
    """Samples n-step transitions uniformly over slots and environments.

    The sum of rewards stops where an episode ends. After a truncation the value of the episode's
    true last frame counts, after a termination nothing does.

    Args:
      replay: holds more than `n_step` time steps.
      key: consumed.
      batch: number of transitions `B`.
      n_step: most steps to sum over.
      gamma: discount of one step.
    """
    slots, num_envs = replay.steps.reward.shape
    time_key, env_key = jax.random.split(key)
    size = jnp.minimum(replay.count, slots)
    # The last n_step slots have no frame yet to bootstrap from.
    age = jax.random.randint(time_key, (batch,), n_step, size)
    env = jax.random.randint(env_key, (batch,), 0, num_envs)
    start = replay.count - 1 - age

    def at(field: jax.Array, offset: jax.Array | int) -> jax.Array:
        return field[(start + offset) % slots, env]

    steps = replay.steps
    running = jnp.ones((batch,), jnp.bool_)
    reward = jnp.zeros((batch,), jnp.float32)
    masked = jnp.zeros((batch,), jnp.bool_)
    terminated = jnp.zeros((batch,), jnp.bool_)
    length = jnp.zeros((batch,), jnp.int32)
    for offset in range(n_step):
        masked |= running & at(steps.masked, offset)
        reward += jnp.where(running, gamma**offset * at(steps.reward, offset), 0.0)
        length += running.astype(jnp.int32)
        terminated |= running & at(steps.terminated, offset)
        running &= ~(at(steps.terminated, offset) | at(steps.truncated, offset))
    discount = jnp.float32(gamma) ** length.astype(jnp.float32)
    return Batch(
        frame=jax.tree.map(lambda field: at(field, 0), steps.frame),
        action=at(steps.action, 0).astype(jnp.int32),
        reward=jnp.where(masked, 0.0, reward),
        next_frame=jax.tree.map(lambda field: at(field, length), steps.frame),
        discount=jnp.where(terminated | masked, 0.0, discount),
        weight=(~masked).astype(jnp.float32),
    )


def sample_frames(replay: Replay, key: jax.Array, batch: int) -> jax.Array:
    """Samples frames uniformly over slots and environments: pytree of `[B, ...]`.

    Args:
      replay: holds at least one time step.
      key: consumed.
      batch: number of frames `B`.
    """
    slots, num_envs = replay.steps.reward.shape
    time_key, env_key = jax.random.split(key)
    age = jax.random.randint(time_key, (batch,), 0, jnp.minimum(replay.count, slots))
    env = jax.random.randint(env_key, (batch,), 0, num_envs)
    slot = (replay.count - 1 - age) % slots
    return jax.tree.map(lambda field: field[slot, env], replay.steps.frame)
