"""A trained agent in one file: its configuration, its network's parameters, and how it did."""

from __future__ import annotations

import dataclasses
import json
import pathlib
from typing import Any

import flax.serialization
import jax
import jax.numpy as jnp
import numpy as np

from mjx_arm.config import EnvConfig, TrainConfig
from mjx_arm.dqn import DQN, epsilon_greedy
from mjx_arm.env import Env, make_env
from mjx_arm.loop import make_dqn

CONFIG = "config.json"
_FORMAT = "mjx_arm agent 1"
LAST, BEST = "last.agent", "best.agent"


@dataclasses.dataclass(frozen=True, eq=False)
class Agent:
    """A policy with its environment.

    Attributes:
      config: of the run that trained it.
      env: the environment to try it in.
      dqn: the algorithm, with the network.
      params: of the network.
      env_steps: environment steps that it was trained for.
      selection_rate: share of successes in the evaluation that selected it, or None.
    """

    config: TrainConfig
    env: Env
    dqn: DQN
    params: Any
    env_steps: int
    selection_rate: float | None

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
    """Writes `config.json`: whole, or the one before stays."""
    part = folder / f"{CONFIG}.part"
    part.write_text(_dump_config(config) + "\n")
    part.replace(folder / CONFIG)


def load_config(folder: pathlib.Path) -> TrainConfig:
    """Reads `config.json` of a run folder.

    Raises:
      ValueError: the folder holds no configuration of this version.
    """
    path = folder / CONFIG
    if not path.is_file():
        raise ValueError(f"{folder} is no run folder: it has no {CONFIG}")
    return _parse_config(path.read_text(), path)


def save_agent(
    path: pathlib.Path,
    config: TrainConfig,
    params: Any,
    *,
    env_steps: int,
    selection_rate: float | None = None,
) -> None:
    """Writes an agent to one file: whole, or not at all.

    Of the configuration all but the backend of the physics, which is for who tries it to choose.

    Raises:
      ValueError: the disk is full, or the folder cannot be written.
    """
    content = {
        "format": _FORMAT,
        "config": _dump_config(dataclasses.replace(config, physics="auto")),
        "env_steps": env_steps,
        "selection_rate": selection_rate,
        "params": flax.serialization.to_state_dict(jax.device_get(params)),
    }
    part = path.with_name(f"{path.name}.part")
    try:
        part.write_bytes(flax.serialization.msgpack_serialize(content))
        part.replace(path)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise ValueError(f"{path} could not be written: {error.strerror}") from error


def load_agent(
    path: str | pathlib.Path, *, max_steps: int = EnvConfig.max_steps, **options: Any
) -> Agent:
    """Reads a trained agent, with the environment to try it in.

    In environment B that is one where the cube moves after every episode, failed ones included.

    Args:
      path: an agent's file, or a run folder, of which the best agent is taken, or the last one
        where none was selected.
      max_steps: iterations until an episode is truncated, whatever it was in training.
      **options: fields of `TrainConfig` to change, such as `physics` or `env`.

    Raises:
      ValueError: there is no agent, or it is damaged, or an option does not fit.
    """
    path = find_agent(pathlib.Path(path))
    content = _read(path)
    config = dataclasses.replace(_parse_config(content["config"], path), **options)
    env = evaluation_env(config, max_steps)
    dqn = make_dqn(config, env)

    def init() -> Any:
        obs, _ = env.reset(jax.random.key(0))
        return dqn.init_params(jax.random.key(0), jax.tree.map(lambda x: x[None], obs))

    like = jax.eval_shape(init)
    try:
        params = flax.serialization.from_state_dict(like, content["params"])
    except ValueError as error:
        raise ValueError(f"{path} holds the parameters of another network") from error
    if jax.tree.map(np.shape, params) != jax.tree.map(np.shape, like):
        raise ValueError(f"{path} holds the parameters of another network")
    params = jax.tree.map(jnp.asarray, params)
    return Agent(config, env, dqn, params, content["env_steps"], content["selection_rate"])


def evaluation_env(config: TrainConfig, max_steps: int = EnvConfig.max_steps) -> Env:
    """The environment to try an agent in: as in training, but for what training makes easier."""
    trained_in = config.env_config()
    moves = trained_in.cube_moves if trained_in.cube_moves == "never" else "always"
    return make_env(dataclasses.replace(trained_in, cube_moves=moves, max_steps=max_steps))


def find_agent(path: pathlib.Path) -> pathlib.Path:
    """The agent's file that a path means.

    Raises:
      ValueError: there is none.
    """
    if path.is_file():
        return path
    for name in (BEST, LAST):
        if (path / name).is_file():
            return path / name
    if (path / CONFIG).is_file():
        seeds = ", ".join(sorted(str(seed) for seed in path.glob("seed-*")))
        hint = f"give one of {seeds}" if seeds else "the run has not saved one yet"
        raise ValueError(f"{path} holds no agent: {hint}")
    raise ValueError(f"{path} is no run folder and no agent: give one that `train` has made")


def read_selection_rate(path: pathlib.Path) -> float | None:
    """The share of successes with which an agent's file was selected, or None."""
    return _read(path)["selection_rate"] if path.is_file() else None


def _read(path: pathlib.Path) -> dict[str, Any]:
    try:
        content = flax.serialization.msgpack_restore(path.read_bytes())
    except Exception as error:  # msgpack raises a dozen kinds for a file that is none of its own
        raise ValueError(f"{path} is not the file of an agent, or a damaged one") from error
    if not isinstance(content, dict) or content.get("format") != _FORMAT:
        raise ValueError(f"{path} is not the file of an agent of this version")
    return content


def _dump_config(config: TrainConfig) -> str:
    return json.dumps(dataclasses.asdict(config), indent=2)


def _parse_config(text: str, path: pathlib.Path) -> TrainConfig:
    try:
        values = json.loads(text)
        values = {k: tuple(v) if isinstance(v, list) else v for k, v in values.items()}
        return TrainConfig(**values)
    except (AttributeError, TypeError, json.JSONDecodeError) as error:
        raise ValueError(f"{path} has not the configuration of a run: {error}") from error
