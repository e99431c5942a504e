"""A loop of one's own: environments are pure functions, to be jitted, vmapped and scanned."""

from __future__ import annotations

import jax

import mjx_arm

NUM_ENVS = 64


def main() -> None:
    """Runs a random policy in 64 environments and prints how fast and how far it came."""
    env = mjx_arm.make("B", observation="rgb", size=(64, 64))
    auto = mjx_arm.AutoReset(env)  # starts the next episode when one has ended

    def step(carry, key):
        obs, state = carry
        act_key, env_key = jax.random.split(key)
        actions = jax.random.randint(act_key, (NUM_ENVS,), 0, env.num_actions)
        keys = jax.random.split(env_key, NUM_ENVS)
        obs, state, reward, *_, info = jax.vmap(auto.step)(keys, state, actions)
        return (obs, state), (reward.mean(), info["distance"].mean(), info["grasped"].mean())

    @jax.jit
    def run(key):
        reset_key, key = jax.random.split(key)
        start = jax.vmap(auto.reset)(jax.random.split(reset_key, NUM_ENVS))
        (obs, _), (reward, distance, grasped) = jax.lax.scan(
            step, start, jax.random.split(key, 200)
        )
        return obs, reward, distance, grasped

    obs, reward, distance, grasped = run(jax.random.key(0))
    print(f"observations {obs.shape} {obs.dtype}")
    print(f"mean reward {float(reward.mean()):.3f}, mean distance {float(distance.mean()):.3f} m")
    print(f"steps with the cube grasped: {100 * float(grasped.mean()):.2f} %")


if __name__ == "__main__":
    main()
