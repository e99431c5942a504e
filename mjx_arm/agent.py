"""A trained agent: its configuration, network and parameters, read back from a run folder."""

from __future__ import annotations

import dataclasses
import json
import pathlib
from typing import Any

import jax
import jax.numpy as jnp

from mjx_arm.checkpoint import load_tree, save_tree
from mjx_arm.config import EnvConfig, TrainConfig
from mjx_arm.dqn import DQN, epsilon_greedy
from mjx_arm.env import Env, make_env
from mjx_arm.loop import make_dqn

_CONFIG = "config.json"
_PARAMS = "params"


@dataclasses.dataclass(frozen=True, eq=False)
class Agent:
    """A policy with its environment.

    Attributes:
      config: of the run that trained it.
      env: the environment to try it in.
      dqn: the algorithm, with the network.
      params: of the network.
    """

    config: TrainConfig
    env: Env
    dqn: DQN
    params: Any

    def act(self, obs: jax.Array, key: jax.Array, epsilon: float = 0.0) -> jax.Array:
        """Chooses an action.

        Args:
          obs: one observation of `env`: `[H, W] uint32` packed pixels.
          key: consumed.
          epsilon: share of random actions.

        Returns:
          `[] int32`, 0 to 13.
        """
        return epsilon_greedy(key, self.dqn.apply(self.params, obs[None]), jnp.float32(epsilon))[0]


def save_config(folder: pathlib.Path, config: TrainConfig) -> None:
    """Writes `config.json`."""
    (folder / _CONFIG).write_text(json.dumps(dataclasses.asdict(config), indent=2) + "\n")


def load_config(folder: pathlib.Path) -> TrainConfig:
    """Reads `config.json` of a run folder.

    Raises:
      ValueError: the folder holds no configuration of this version.
    """
    path = folder / _CONFIG
    if not path.is_file():
        raise ValueError(f"{folder} is no run folder: it has no {_CONFIG}")
    try:
        values = json.loads(path.read_text())
        values = {k: tuple(v) if isinstance(v, list) else v for k, v in values.items()}
        return TrainConfig(**values)
    except (TypeError, json.JSONDecodeError) as error:
        raise ValueError(f"{path} is not the configuration of a run: {error}") from error


def save_agent_params(folder: pathlib.Path, params: Any) -> None:
    """Writes the parameters of a run folder's agent."""
    save_tree(folder / _PARAMS, params)


def load_agent(
    folder: str | pathlib.Path, *, max_steps: int = EnvConfig.max_steps, **options: Any
) -> Agent:
    """Reads a trained agent, with the environment to try it in.

    In environment B that is one where the cube moves after every episode, failed ones included.

    Args:
      folder: a run folder.
      max_steps: iterations until an episode is truncated, whatever it was in training.
      **options: fields of `TrainConfig` to change, such as `physics` or `env`.

    Raises:
      ValueError: the folder holds no agent, or an option does not fit.
    """
    folder = pathlib.Path(folder)
    config = dataclasses.replace(load_config(folder), **options)
    trained_in = config.env_config()
    moves = trained_in.cube_moves if trained_in.cube_moves == "never" else "always"
    env = make_env(dataclasses.replace(trained_in, cube_moves=moves, max_steps=max_steps))
    dqn = make_dqn(config, env)

    def init() -> Any:
        obs, _ = env.reset(jax.random.key(0))
        return dqn.init_params(jax.random.key(0), jax.tree.map(lambda x: x[None], obs))

    return Agent(config, env, dqn, load_tree(folder / _PARAMS, jax.eval_shape(init)))
