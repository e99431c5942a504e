"""A reward of one's own: any function of the state before, the state after and the action.

`before` and `after` are snapshots: `measured` has the task's quantities by name, and `state` the
whole state. The reward is the sum of the terms; each appears in `info` as `reward_NAME`.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

import mjx_arm


def reward(
    before: mjx_arm.Snapshot, after: mjx_arm.Snapshot, action: jax.Array
) -> dict[str, jax.Array]:
    """Pays for being near the cube, for a grasp and for height; fast joints cost a little."""
    speed = jnp.sum(jnp.square(after.state.physics.qvel[:6]))
    grasped = after.measured["grasped"].astype(jnp.float32)
    return {
        "near": 0.2 * jnp.exp(-10.0 * after.measured["distance"]),
        "grasp": 0.3 * grasped,
        "lift": grasped * after.measured["height"],
        "calm": -1e-4 * speed,
        "success": 100.0 * after.measured["success"].astype(jnp.float32),
    }


def main() -> None:
    """Prints the terms of one step, then trains for a moment."""
    env = mjx_arm.make("A", reward=reward, observation="state")
    _, state = jax.jit(env.reset)(jax.random.key(0))
    info = jax.jit(env.step)(jax.random.key(1), state, 3)[5]
    print({name: float(x) for name, x in info.items() if name.startswith("reward_")})

    config = mjx_arm.train_config(
        observation="state", num_envs=16, total_steps=8_192, chunk_steps=4_096, replay_size=20_000
    )
    trainer = mjx_arm.make_trainer(config, reward=reward)
    state = trainer.init(jax.random.key(0))
    for _ in range(config.num_chunks):
        state, counts = trainer.run_chunk(state)
    print(f"mean loss {float(counts['loss'] / counts['updates']):.4f}")


if __name__ == "__main__":
    main()
