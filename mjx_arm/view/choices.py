"""What the viewer can show: the agents of a run, those that come with the package, or a scene."""

from __future__ import annotations

import dataclasses
import json
import pathlib
from typing import Any

import flax.traverse_util
import jax.numpy as jnp

from mjx_arm.envs.env import Env, make
from mjx_arm.envs.tasks import find_task, task_names
from mjx_arm.report.metrics import read_metrics
from mjx_arm.scene import available_scenes, scene_exists
from mjx_arm.training.agent import (
    BEST,
    LAST,
    Agent,
    find_agent,
    load_agent,
    read_agent,
    shipped_agents,
)
from mjx_arm.training.run_folder import load_config, seed_folders


@dataclasses.dataclass(frozen=True)
class Choice:
    """An agent that the viewer offers.

    Attributes:
      name: what it is called in the viewer.
      path: its file.
    """

    name: str
    path: pathlib.Path

    @property
    def version(self) -> int:
        """Changes when the file is written again; 0 while there is none."""
        try:
            return self.path.stat().st_mtime_ns
        except OSError:
            return 0


def find_choices(subject: pathlib.Path) -> list[Choice]:
    """The agents to choose from, the one that `subject` means first.

    Args:
      subject: a run folder, an agent's file, or the name of an agent that comes with the package.

    Raises:
      ValueError: there is no agent, and what was given is no scene either.
    """
    choices = _of_run(subject) if (subject / "config.json").is_file() else []
    if not choices:
        try:
            found = find_agent(subject)
        except ValueError as error:
            if (subject / "config.json").is_file():
                raise
            raise ValueError(f"{error}, or a scene: {', '.join(available_scenes())}") from None
        choices = [Choice(found.stem, found)]
    taken = {choice.path for choice in choices}
    shipped = [Choice(name, find_agent(pathlib.Path(name))) for name in shipped_agents()]
    return choices + [choice for choice in shipped if choice.path not in taken]


def _of_run(folder: pathlib.Path) -> list[Choice]:
    seeds = seed_folders(folder, load_config(folder))
    choices = []
    for seed in seeds:
        prefix = f"{seed.name}/" if len(seeds) > 1 else ""
        for name in (BEST, LAST):
            if (seed / name).is_file():
                choices.append(Choice(f"{prefix}{pathlib.Path(name).stem}", seed / name))
    return choices


def is_scene(subject: pathlib.Path) -> bool:
    """Whether a name or path means a scene, and no agent."""
    return (
        str(subject) not in shipped_agents()
        and scene_exists(str(subject))
        and (subject.suffix != ".safetensors")
    )


def scene_env(scene: str, task: str | None, **options: Any) -> Env:
    """The environment that shows a scene without an agent.

    Args:
      scene: name or path.
      task: by default the first one that takes this scene by default, or `lift`.
      **options: of `mjx_arm.make`.

    Raises:
      ValueError: scene and task do not fit.
    """
    if task is None:
        own = [name for name in task_names() if find_task(name).scene == scene]
        task = (own or ["lift"])[0]
    return make(**{"env": "A", **options}, scene=scene, task=task, observation="packed")


def read_params(choice: Choice, agent: Agent) -> tuple[Any, int] | None:
    """The parameters in an agent's file that was written again, and its environment steps.

    Returns:
      None if the file holds another kind of agent than `agent`, which must be loaded whole.

    Raises:
      ValueError: the file is damaged.
    """
    metadata, tensors = read_agent(choice.path)
    flat = flax.traverse_util.flatten_dict(agent.params, sep="/")
    if {name: (x.shape, x.dtype) for name, x in tensors.items()} != {
        name: (x.shape, x.dtype) for name, x in flat.items()
    }:
        return None
    arrays = {name: jnp.asarray(tensors[name]) for name in flat}
    params = flax.traverse_util.unflatten_dict(arrays, sep="/")
    return params, json.loads(metadata["env_steps"])


def load_choice(choice: Choice, **options: Any) -> Agent:
    """The agent of a choice; see `load_agent`."""
    return load_agent(choice.path, **options)


def training_line(choice: Choice) -> str:
    """Where the training of an agent stands, in words; empty where there are no metrics."""
    folder = choice.path.parent
    if not (folder / "metrics.jsonl").is_file():
        return ""
    try:
        last = read_metrics(folder)[-1]
    except ValueError:
        return ""
    rate = last.get("success_rate", float("nan"))
    success = "" if rate != rate else f", success {100 * rate:.0f} %"
    return f"training: {int(last['env_steps']):,} steps{success}"
