"""A task of one's own: raise the grasp site. Registered, it works everywhere by its name.

On the command line: `mjx-arm train --task own_task:raise_hand --reward height`.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

import mjx_arm


class RaiseHand:
    """The grasp site is to be 50 cm above the table. It has the members of `mjx_arm.Task`."""

    def __init__(self, config, scene, arm):
        self.arm, self.varies, self.obstacles, self.feature_scales = arm, {}, (), (5.0,)
        self.rewards = {"height": self.reward}

    def fixed_placement(self):
        return ()  # no objects

    def sample_placement(self, key):
        return ()

    def start(self, qpos, ctrl, placement):
        return qpos, ctrl, {}

    def accepts(self, poses, placement):
        return jnp.ones((), bool)

    def measure(self, state):
        height = state.physics.poses.site_xpos[self.arm.grasp_site, 2]
        return {"height": height, "success": height > 0.5}

    def features(self, state):
        return state.physics.poses.site_xpos[self.arm.grasp_site, 2:]

    def reward(self, before, after, action):
        return {"height": after.measured["height"], "success": 10.0 * after.measured["success"]}


mjx_arm.register("raise_hand", RaiseHand, scene="arm_cube", units={"height": "m"})


def main() -> None:
    """Trains it for a moment from state features."""
    config = mjx_arm.train_config(
        task="raise_hand", reward="height", observation="state", num_envs=16,
        total_steps=32_768, chunk_steps=8_192, epsilon_steps=16_384, replay_size=40_000,
    )  # fmt: skip
    _, counts = jax.jit(mjx_arm.make_train(config))(jax.random.key(0))
    print("successes in each chunk:", counts["successes"].astype(int).tolist())


if __name__ == "__main__":
    main()
