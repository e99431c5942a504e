"""A network of one's own: any Flax module from observations `[B, ...]` to Q-values `[B, A]`."""

from __future__ import annotations

import flax.linen as nn
import jax
import jax.numpy as jnp

import mjx_arm


class SmallNetwork(nn.Module):
    """Blocks of 8 by 8 pixels, each mapped by the same dense layer, then two dense layers."""

    num_actions: int

    @nn.compact
    def __call__(self, packed: jax.Array) -> jax.Array:
        """Q-values `[B, num_actions]` of packed pixels `[B, H, W] uint32`."""
        x = mjx_arm.rgb(packed).astype(jnp.float32) / 255.0 - 0.5
        batch, height, width, channels = x.shape
        x = x.reshape(batch, height // 8, 8, width // 8, 8, channels)
        x = x.transpose(0, 1, 3, 2, 4, 5).reshape(batch, height // 8, width // 8, -1)
        x = nn.relu(nn.Dense(16)(x)).reshape(batch, -1)
        x = nn.relu(nn.Dense(64)(x))
        return nn.Dense(self.num_actions)(x)


def main() -> None:
    """Trains it for a moment; `mjx-arm train --network own_network:SmallNetwork` does the same."""
    config = mjx_arm.train_config(
        size=(32, 32), num_envs=16, total_steps=8_192, chunk_steps=4_096, replay_size=20_000
    )
    env = mjx_arm.make("A")
    network = SmallNetwork(num_actions=env.num_actions)
    trainer = mjx_arm.make_trainer(config, network=network)
    state = trainer.init(jax.random.key(0))
    for _ in range(config.num_chunks):
        state, counts = trainer.run_chunk(state)
    size = sum(x.size for x in jax.tree.leaves(state.learner.params))
    print(f"{size:,} parameters, mean loss {float(counts['loss'] / counts['updates']):.4f}")


if __name__ == "__main__":
    main()
