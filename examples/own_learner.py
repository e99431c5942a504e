"""A learner of one's own: Q-learning of a linear map from state features, no target network.

It has the members of `Algorithm` in `mjx_arm/algos/base.py`, which explains each of them.
"""

import jax
import jax.numpy as jnp

import mjx_arm
from mjx_arm.algos.frames import make_frames
from mjx_arm.algos.replay import sample


class LinearQ:
    """Q-values are a matrix product of the scaled state features."""

    metrics = {"loss": "updates"}  # noqa: RUF012  # sum that `learn` returns -> count of its terms

    def __init__(self, config, env):
        self.gamma, self.actions = config.algo.gamma, env.num_actions
        self.scales, self.frames = jnp.asarray(env.feature_scales), make_frames(env, "states")

    def init(self, key, obs, frame=None):
        return {"weights": jnp.zeros((obs.shape[-1], self.actions))}

    init_policy = init

    def apply(self, params, obs):
        return jnp.clip(obs * self.scales, -2.0, 2.0) @ params["weights"]

    def acts_on_obs(self, env_steps):
        return True

    def q_values(self, learner, obs, frame, env_steps):
        return self.apply(learner, obs)

    def policy(self, learner):
        return learner

    def with_policy(self, learner, params):
        return params

    def learn(self, key, learner, replay, env_steps):
        def loss(params, batch):
            q = self.apply(params, self.frames.decode(batch.frame))
            following = self.apply(learner, self.frames.decode(batch.next_frame)).max(axis=-1)
            error = q[jnp.arange(64), batch.action] - batch.reward - batch.discount * following
            return jnp.mean(batch.weight * jnp.square(error))

        batch = sample(replay, key, batch=64, n_step=1, gamma=self.gamma)
        value, grads = jax.value_and_grad(loss)(learner, batch)
        ready = (replay.count > 100).astype(jnp.float32)  # before, the batch holds no transitions
        learner = jax.tree.map(lambda x, g: x - ready * 0.01 * g, learner, grads)
        return learner, {"loss": ready * value, "updates": ready}


if __name__ == "__main__":
    config = mjx_arm.train_config(observation="state", num_envs=16, total_steps=8_192)
    _, counts = jax.jit(mjx_arm.make_train(config, algorithm=LinearQ))(jax.random.key(0))
    print("mean loss of each chunk:", counts["loss"] / counts["updates"])
