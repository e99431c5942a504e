"""The tasks, by name; `register` adds a user's own."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Mapping
from typing import Any

from mjx_arm.envs.tasks.base import Task, TaskConfig
from mjx_arm.envs.tasks.lift import Lift, LiftConfig
from mjx_arm.envs.tasks.push import Push, PushConfig
from mjx_arm.envs.tasks.reach import Reach, ReachConfig
from mjx_arm.options import check_name, check_value
from mjx_arm.references import is_reference, load_module


@dataclasses.dataclass(frozen=True)
class TaskEntry:
    """A registered task.

    Attributes:
      make: `(config, scene, arm) -> Task`.
      config: the class of its options.
      scene: name or path of the scene that it takes by default.
      units: of the numbers that it measures, by their names.
    """

    make: Callable[..., Task]
    config: type[TaskConfig]
    scene: str
    units: Mapping[str, str] = dataclasses.field(default_factory=dict)


_tasks: dict[str, TaskEntry] = {}
# Functions that are called with the name of each new task; see `on_register`.
_listeners: list[Callable[[str], None]] = []
# A colon would make a name a reference, and gymnasium's ids are made of names.
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]*")


def register(
    name: str,
    make: Callable[..., Task],
    *,
    config: type[TaskConfig] = TaskConfig,
    scene: str = "arm_cube",
    units: Mapping[str, str] | None = None,
) -> None:
    """Makes a task known by a name, for `make`, configurations and the command line.

    Args:
      name: a new name.
      make: `(config, scene, arm) -> Task`, such as the task's class.
      config: the class of the task's options, made by `mjx_arm.options.options`.
      scene: name or path of the scene that the task takes by default.
      units: of the numbers that the task measures, for figures: `{"distance": "m"}`.

    Raises:
      ValueError: the name is taken by another task, or is not made of letters, digits, `_` and `-`;
        or `make` is no function.
    """
    entry = TaskEntry(make, config, scene, dict(units or {}))
    check_value("name", str, name)
    if not _NAME.fullmatch(name):
        raise ValueError(
            f"the name of a task must be a letter, then letters, digits, _ and -, got {name!r}"
        )
    if not callable(make):
        raise ValueError(
            f"the task {name!r} must be made by a function (config, scene, arm), such as its "
            f"class, got {make!r}"
        )
    if name in _tasks:
        if _tasks[name] != entry:
            raise ValueError(f"the task {name!r} is registered already: give another name")
        return
    for listener in _listeners:
        listener(name)
    _tasks[name] = entry


def on_register(listener: Callable[[str], None]) -> None:
    """Calls a function with the name of each task, now and when one is registered.

    Args:
      listener: may raise ValueError, and the task is not registered.
    """
    for name in _tasks:
        listener(name)
    _listeners.append(listener)


def find_task(name: str) -> TaskEntry:
    """The registered task of a name, or of `module:name`, where importing the module registers it.

    Raises:
      ValueError: no task has this name, or the module cannot be imported.
    """
    if is_reference(name):
        module, _, name = name.partition(":")
        load_module(module, "task")
    check_name("task", name, _tasks)
    return _tasks[name]


def task_names() -> list[str]:
    """Names of all registered tasks."""
    return list(_tasks)


register("lift", Lift, config=LiftConfig, units={"height": "m", "distance": "m"})
register("reach", Reach, config=ReachConfig, scene="arm_reach", units={"distance": "m"})
register(
    "push",
    Push,
    config=PushConfig,
    scene="arm_push",
    units={"distance": "m", "to_cube": "m"},
)

__all__: list[Any] = [
    "Task",
    "TaskConfig",
    "TaskEntry",
    "find_task",
    "on_register",
    "register",
    "task_names",
]
