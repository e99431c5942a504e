"""A trained agent in one file: configuration, scene, parameters, how it did, and a digest."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
import os
import pathlib
from collections.abc import Mapping
from typing import Any

import flax.traverse_util
import jax
import jax.numpy as jnp
import numpy as np
import safetensors
import safetensors.numpy

from mjx_arm.algos.base import Algorithm
from mjx_arm.algos.exploration import check_epsilon, epsilon_greedy
from mjx_arm.config import TrainConfig, dump_config, parse_config, set_train_options
from mjx_arm.envs.config import EnvConfig
from mjx_arm.envs.env import Env, make_env
from mjx_arm.options import flat_names, get_option, invalid, set_options
from mjx_arm.scene import Scene, SceneSource, compile_scene, load_scene, read_source, scene_exists
from mjx_arm.training.algorithm import make_algorithm
from mjx_arm.training.objects import Objects, Record, check_record
from mjx_arm.training.run_folder import CONFIG, load_run

_FORMAT = "mjx_arm agent 2"
LAST, BEST = "last.safetensors", "best.safetensors"
_AGENTS = pathlib.Path(__file__).parents[1] / "agents"
# Means the scene in an agent's file where a scene's name is asked for.
STORED = "stored"
# What an agent sees; all other options of the environment are fixed by its name.
_SIGHT = ("scene", "task", "observation", "size", "camera", "shadows", "samples")


@dataclasses.dataclass(frozen=True, eq=False)
class Agent:
    """A policy with its environment.

    Attributes:
      config: of the run that trained it, with the options that were changed for loading.
      trained_env: options of the environment that it was trained in.
      env: the environment to try it in.
      algorithm: the algorithm, with the network.
      params: of the network.
      env_steps: environment steps that it was trained for.
      selection_rate: share of successes in the evaluation that selected it, or None.
      evaluation: result of the evaluation at the end of its run, or None.
      card: text about the agent, in Markdown; empty if there is none.
    """

    config: TrainConfig
    trained_env: EnvConfig
    env: Env
    algorithm: Algorithm
    params: Any
    env_steps: int
    selection_rate: float | None
    evaluation: dict[str, Any] | None = None
    card: str = ""

    def apply(self, params: Any, obs: jax.Array) -> jax.Array:
        """Q-values of observations `[N, ...]`, `[N, A] float32`."""
        return self.algorithm.apply(params, obs)

    def q_values(self, obs: jax.Array) -> jax.Array:
        """Q-values of one observation of `env`, `[A] float32`."""
        return self.algorithm.apply(self.params, obs[None])[0]

    def act(self, obs: jax.Array, key: jax.Array, epsilon: float = 0.0) -> jax.Array:
        """Chooses an action.

        Args:
          obs: one observation of `env`: `[H, W] uint32` packed pixels.
          key: consumed.
          epsilon: share of random actions.

        Returns:
          `[] int32`.

        Raises:
          ValueError: `epsilon` is not from 0 to 1.
        """
        if not isinstance(epsilon, jax.Array):
            check_epsilon(epsilon)
        return epsilon_greedy(key, self.q_values(obs)[None], jnp.float32(epsilon))[0]


def save_agent(
    path: pathlib.Path,
    config: TrainConfig,
    params: Any,
    *,
    scene: SceneSource,
    objects: Record,
    env_steps: int,
    selection_rate: float | None = None,
    evaluation: Mapping[str, Any] | None = None,
    card: str = "",
) -> None:
    """Writes an agent to one file: whole, or not at all.

    The backend of the physics is left to the user who tries the agent.

    Args:
      path: of the file, which ends in `.safetensors`.
      config: of the run.
      params: of the network.
      scene: the files of the scene.
      objects: record of the user's own objects.
      env_steps: environment steps of the training.
      selection_rate: share of successes in the evaluation that selected it.
      evaluation: result of an evaluation, as a JSON object.
      card: text about the agent.

    Raises:
      ValueError: the disk is full, or the folder cannot be written.
    """
    config = dataclasses.replace(config, env=dataclasses.replace(config.env, physics="auto"))
    tensors = {name: np.asarray(x) for name, x in flatten_params(jax.device_get(params)).items()}
    metadata = {
        "format": _FORMAT,
        "config": json.dumps(dump_config(config)),
        "scene": json.dumps(scene.to_json()),
        "objects": json.dumps(objects),
        "env_steps": json.dumps(env_steps),
        "selection_rate": json.dumps(selection_rate),
        "evaluation": json.dumps(evaluation),
        "card": card,
    }
    _write(path, metadata, tensors)


def add_evaluation(path: pathlib.Path, evaluation: Mapping[str, Any]) -> None:
    """Writes the result of an evaluation into an agent's file.

    Raises:
      ValueError: the file is damaged, or cannot be written.
    """
    metadata, tensors = read_agent(path)
    _write(path, metadata | {"evaluation": json.dumps(evaluation)}, tensors)


def _write(
    path: pathlib.Path, metadata: Mapping[str, str], tensors: Mapping[str, np.ndarray]
) -> None:
    sealed = {**metadata, "sha256": _digest(metadata, tensors)}
    part = path.with_name(f"{path.name}.part")
    try:
        part.write_bytes(safetensors.numpy.save(dict(tensors), sealed))
        part.replace(path)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise ValueError(f"{path} could not be written: {error.strerror or error}") from error


def flatten_params(params: Any) -> dict[str, Any]:
    """Parameters by names such as `params/Dense_0/kernel`."""
    flat: dict[str, Any] = flax.traverse_util.flatten_dict(params, sep="/")
    return flat


def _digest(metadata: Mapping[str, str], tensors: Mapping[str, np.ndarray]) -> str:
    sha = hashlib.sha256()
    for name in sorted(metadata):
        sha.update(json.dumps([name, metadata[name]]).encode())
    for name in sorted(tensors):
        x = tensors[name]
        sha.update(json.dumps([name, str(x.dtype), list(x.shape)]).encode())
        sha.update(np.ascontiguousarray(x).tobytes())
    return sha.hexdigest()


def read_agent(path: pathlib.Path) -> tuple[dict[str, str], dict[str, np.ndarray]]:
    """Metadata and tensors of an agent's file.

    Raises:
      ValueError: it is not the file of an agent of this version, or it is damaged.
    """
    try:
        with safetensors.safe_open(path, framework="np") as file:
            metadata = dict(file.metadata() or {})
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (safetensors.SafetensorError, OSError, TypeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is not the file of an agent, or it is damaged") from error
    if metadata.get("format") != _FORMAT:
        raise ValueError(f"{path} is not the file of an agent of this version")
    if metadata.pop("sha256", None) != _digest(metadata, tensors):
        raise ValueError(f"{path} is damaged: it does not match its own digest")
    return metadata, tensors


def load_agent(
    path: str | pathlib.Path,
    *,
    max_steps: int = 1_000,
    env: str | Env | None = None,
    network: Any = None,
    reward: Any = None,
    algorithm: Any = None,
    scene: str | pathlib.Path | None = None,
    **options: Any,
) -> Agent:
    """Reads a trained agent, with the environment to try it in.

    What the agent sees and what domain randomisation varies are as in its training, with ranges at
    their full width; all else is as the environment's name fixes it:
    1,000 iterations, and in B new places for all objects after every episode, failed ones included.

    Args:
      path: an agent's file, or a run folder, of which the best agent is taken, or the last one
        where none was selected.
      max_steps: iterations until an episode is truncated.
      env: `"A"` or `"B"`; by default the one that it was trained in. If the agent was trained in
        an environment that was passed as an object, that object: it judges the agent as it is.
      network: the Flax module, if the agent was trained with one that was passed as an object.
      reward: the same for a reward.
      algorithm: the same for an algorithm.
      scene: name or path of a scene, or `"stored"` for the one in the agent's file; by default the
        one that it was trained in, as long as that has not changed.
      **options: other options to change, such as `physics`.

    Raises:
      ValueError: there is no agent, or it is damaged, or an option does not fit, or the scene is
        not the one in the agent's file any more.
    """
    if not isinstance(path, str | os.PathLike):
        raise ValueError(invalid("path", str, path))
    path = find_agent(pathlib.Path(path))
    metadata, tensors = read_agent(path)
    trained = parse_config(metadata["config"], str(path))
    own = env if isinstance(env, Env) else None
    objects = Objects(env=own, network=network, reward=reward, algorithm=algorithm)
    check_record(json.loads(metadata["objects"]), trained, objects, str(path))
    stored = SceneSource.from_json(json.loads(metadata["scene"]), str(path))
    if isinstance(env, Env):
        given = [*options, *["scene"] * (scene is not None), *["max_steps"] * (max_steps != 1_000)]
        if given:
            raise ValueError(f"make env= with {', '.join(given)}, which it has options for")
        config, made = dataclasses.replace(trained, env=env.config), env
    else:
        judged = evaluation_config(trained.env, env=env, max_steps=max_steps)
        config = set_train_options(dataclasses.replace(trained, env=judged), options)
        if scene is not None and str(scene) != STORED:
            config = set_train_options(config, {"scene": str(scene)})
        found = _find_scene(path, trained, config, stored, scene)
        made = make_env(config.env, reward=reward, scene=found)
    factory = functools.partial(make_algorithm, network=network)
    learner: Algorithm = (algorithm or factory)(config, made)
    params = _restore(path, learner, made, tensors)
    return Agent(
        config,
        trained.env,
        made,
        learner,
        params,
        json.loads(metadata["env_steps"]),
        json.loads(metadata["selection_rate"]),
        json.loads(metadata["evaluation"]),
        read_card(path, metadata),
    )


def _find_scene(
    path: pathlib.Path,
    trained: TrainConfig,
    config: TrainConfig,
    stored: SceneSource,
    wanted: str | pathlib.Path | None,
) -> Scene:
    """The scene that an agent is tried in; see `load_agent`."""
    name = config.env.scene_name
    if wanted is not None and str(wanted) == STORED:
        return compile_scene(trained.env.scene_name, stored)
    if wanted is not None or name != trained.env.scene_name:
        return load_scene(name)
    if scene_exists(name) and read_source(name).digest != stored.digest:
        raise ValueError(
            f"the scene {name!r} is not the one that {path} was trained in: give --scene {STORED} "
            f"for the one in the file, or --scene {name} for the one here"
        )
    return compile_scene(name, stored)


def _restore(
    path: pathlib.Path, algorithm: Algorithm, env: Env, tensors: Mapping[str, np.ndarray]
) -> Any:
    def init() -> Any:
        obs, _ = env.reset(jax.random.key(0))
        return algorithm.init_policy(jax.random.key(0), jax.tree.map(lambda x: x[None], obs))

    expected = flatten_params(jax.eval_shape(init))
    shapes = {name: x.shape for name, x in expected.items()}
    if {name: x.shape for name, x in tensors.items()} != shapes:
        raise ValueError(f"{path} holds the parameters of another network")
    check_tensors(path, tensors, {name: x.dtype for name, x in expected.items()})
    arrays = {name: jnp.asarray(tensors[name]) for name in expected}
    return flax.traverse_util.unflatten_dict(arrays, sep="/")


def check_tensors(
    path: pathlib.Path, tensors: Mapping[str, np.ndarray], dtypes: Mapping[str, Any]
) -> None:
    """Rejects the tensors of an agent that have another dtype or are not finite, by name.

    Raises:
      ValueError: one has, or is not.
    """
    for name, dtype in dtypes.items():
        x = tensors[name]
        if x.dtype != dtype:
            raise ValueError(f"{path}: {name!r} must be of type {dtype}, got {x.dtype}")
        if not np.isfinite(x).all():
            raise ValueError(f"{path}: {name!r} must hold finite numbers, got inf or nan")


def evaluation_config(
    trained: EnvConfig, *, env: str | None = None, max_steps: int = 1_000
) -> EnvConfig:
    """Options of the environment that judges an agent; see `load_agent`."""
    sight = {name: getattr(trained, name) for name in _SIGHT}
    start = EnvConfig(
        task_options=type(trained.task_options)(),
        reward=trained.reward,
        reward_scale=trained.reward_scale,
        physics=trained.physics,
        max_steps=max_steps,
        randomise=dataclasses.replace(trained.randomise, growth_steps=0),
        **sight,
    )
    start = set_options(start, {"env": env or trained.env})
    placement = "fixed" if start.placed == "fixed" else "always"
    return set_options(start, {"placement": placement})


def differences(trained: EnvConfig, judged: EnvConfig) -> dict[str, tuple[Any, Any]]:
    """Options in which an agent's training differs from what it is judged in."""
    names = [name for name in flat_names(judged) if name not in ("physics", "placement")]
    pairs = {name: (get_option(trained, name), get_option(judged, name)) for name in names}
    return {name: pair for name, pair in pairs.items() if pair[0] != pair[1]}


def find_agent(path: pathlib.Path) -> pathlib.Path:
    """The agent's file that a path means, or the name of an agent that comes with the package.

    Raises:
      ValueError: there is none, or the run is of another version.
    """
    shipped = _AGENTS / f"{path}.safetensors"
    if not path.exists() and str(path) in shipped_agents():
        return shipped
    if path.is_file():
        if path.suffix == ".agent":
            raise ValueError(
                f"{path} is an agent of mjx_arm 0.1, which this version cannot read: train again, "
                "or install mjx_arm 0.1"
            )
        return path
    for name in (BEST, LAST):
        if (path / name).is_file():
            return path / name
    if (path / CONFIG).is_file():
        load_run(path)  # rejects runs of other versions, whose agents have other names
        seeds = ", ".join(sorted(str(seed) for seed in path.glob("seed-*")))
        hint = f"give one of {seeds}" if seeds else "the run has not saved one yet"
        raise ValueError(f"{path} holds no agent: {hint}")
    raise ValueError(
        f"{path} is not a run folder and not an agent: give one that `train` has made, or one of "
        f"{', '.join(shipped_agents())}"
    )


def shipped_agents() -> list[str]:
    """Names of the agents that come with the package; beside each file is its card."""
    return sorted(path.stem for path in _AGENTS.glob("*.safetensors"))


def read_card(path: pathlib.Path, metadata: Mapping[str, str]) -> str:
    """The text about an agent, in Markdown; empty if there is none.

    The card of an agent that comes with the package is the file beside it. It is written after the
    evaluations, and the agent's file is not changed for it.

    Args:
      path: of the agent's file.
      metadata: of the file, from `read_agent`.
    """
    beside = path.with_suffix(".md")
    if path.parent == _AGENTS and beside.is_file():
        return beside.read_text(encoding="utf-8")
    return metadata["card"]


def read_selection_rate(path: pathlib.Path) -> float | None:
    """The share of successes with which an agent's file was selected, or None."""
    if not path.is_file():
        return None
    rate: float | None = json.loads(read_agent(path)[0]["selection_rate"])
    return rate
