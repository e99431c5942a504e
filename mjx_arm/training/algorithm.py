"""The algorithm of a configuration."""

from __future__ import annotations

from typing import Any

import flax.linen as nn

from mjx_arm.algos.base import Algorithm
from mjx_arm.algos.distill import Distill
from mjx_arm.algos.dqn import DQN, QLearning, make_adam, make_q_learning
from mjx_arm.algos.frames import make_frames
from mjx_arm.config import DistillConfig, DQNConfig, TrainConfig
from mjx_arm.envs.env import Env
from mjx_arm.networks import FeatureQNetwork, make_network
from mjx_arm.references import reference_to
from mjx_arm.shard import WHOLE, Shard


def make_algorithm(
    config: TrainConfig, env: Env, network: Any = None, *, shard: Shard = WHOLE
) -> Algorithm:
    """Makes the algorithm of a configuration.

    Args:
      config: the options.
      env: the environment that it trains in.
      network: a Flax module `observations [B, ...] -> Q-values [B, A]`; by default the one that
        the configuration names.
      shard: the part of the environments and of each batch that the algorithm sees. Its `learn`
        then runs inside `jax.shard_map` and averages its gradients over all parts.

    Raises:
      ValueError: the network cannot be made, or is not a Flax module.
    """
    from_state = config.env.observation == "state"
    if network is None:
        network = make_network(
            config.network,
            num_actions=env.num_actions,
            feature_scales=env.feature_scales if from_state else None,
        )
    if not isinstance(network, nn.Module):
        name = config.network.network or reference_to(network)
        raise ValueError(
            f"network {name!r} must be a Flax module, got an object of type "
            f"{type(network).__name__}"
        )
    storage, algo = config.replay.storage, config.algo
    if isinstance(algo, DistillConfig):
        frames = make_frames(env, storage, with_features=True)
        teacher = make_teacher(algo, env, shard)
        return Distill(algo, frames, teacher, network, config.num_envs)
    assert isinstance(algo, DQNConfig)
    learning = make_q_learning(algo, network, pixels=not from_state, shard=shard)
    return DQN(algo, make_frames(env, storage), learning, config.num_envs)


def make_teacher(config: DistillConfig, env: Env, shard: Shard = WHOLE) -> QLearning:
    """Q-learning of a network that sees the state features."""
    network: Any = FeatureQNetwork(
        env.num_actions,
        config.teacher_hidden,
        dueling=config.teacher_dueling,
        scales=env.feature_scales,
        layer_norm=config.teacher_layer_norm,
    )
    return QLearning(
        apply=network.apply,
        init_params=network.init,
        optimizer=make_adam(config.teacher_learning_rate, 10.0),
        double=config.teacher_double,
        huber=config.teacher_huber,
        polyak=config.teacher_polyak,
        target_period=1,
        shard=shard,
    )
