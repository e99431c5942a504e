"""A user's own objects in a run: recorded by import path and digest of their source."""

from __future__ import annotations

import dataclasses
import uuid
from collections.abc import Collection, Mapping
from typing import Any

from mjx_arm.config import TrainConfig
from mjx_arm.envs.tasks import find_task
from mjx_arm.references import (
    has_lasting_source,
    instance_text,
    is_of_package,
    is_reference,
    load_reference,
    reference_to,
)
from mjx_arm.references import source_digest as digest_of

Record = dict[str, dict[str, str]]

# Objects that only this process has, such as lambdas, by the token that a record has of them.
_ONLY_HERE: dict[str, Any] = {}
# Objects that the command line takes as `module:name`.
ON_COMMAND_LINE = ("reward", "network")


@dataclasses.dataclass(frozen=True, eq=False)
class Objects:
    """What a user passes to `train`, `resume`, `make_trainer` and `load_agent` as objects.

    Attributes:
      env: an environment.
      network: a Flax module.
      reward: a function.
      algorithm: a function that makes an algorithm.
    """

    env: Any = None
    network: Any = None
    reward: Any = None
    algorithm: Any = None

    def given(self) -> dict[str, Any]:
        """Those that were passed, by name."""
        named = ((field.name, getattr(self, field.name)) for field in dataclasses.fields(self))
        return {name: value for name, value in named if value is not None}


def record(config: TrainConfig, objects: Objects) -> Record:
    """Import path and digest of all that is not part of the package.

    An instance also has its values, as text. An object that no other process can have, such as a
    lambda, has a token in place of the digest.
    """
    given = objects.given()
    found = {
        name: {"given": reference_to(value), **_identity(name, value)}
        for name, value in given.items()
    }
    for name, path in _named(config).items():
        if name not in given:
            found[name] = {"path": path, **_identity(name, _find(name, path, config, objects))}
    return found


def parse_record(values: Any, where: str) -> Record:
    """Checks what a JSON file has as the record of a run, and returns it.

    Raises:
      ValueError: it is not a record.
    """
    entries = values.values() if isinstance(values, dict) else [None]
    if all(isinstance(x, dict) and all(isinstance(y, str) for y in x.values()) for x in entries):
        record: Record = values
        return record
    raise ValueError(f"{where}: 'objects' must be the record of a run, got {values!r}")


def only_here(recorded: Record) -> list[str]:
    """A sentence about each object that no other process can have."""
    return [
        f"{name} is {_path(entry)}, which no other process can have: this run cannot be resumed, "
        "nor its agent be loaded, after this process has ended; to keep them, define it at the top "
        "of a file"
        for name, entry in recorded.items()
        if "only_in" in entry
    ]


def check_record(recorded: Record, config: TrainConfig, objects: Objects, where: str) -> None:
    """Rejects objects that are not those of the record.

    Raises:
      ValueError: one is missing, or another one, or its source or its values have changed.
    """
    given = objects.given()
    for name, entry in recorded.items():
        path = _path(entry)
        made = f"{where} was made with {name}={path}"
        missing = "given" in entry and name not in given
        if missing and "only_in" not in entry:
            raise ValueError(f"{made}: pass it again as {name}=")
        value = None if missing else _find(name, path, config, objects)
        if "only_in" in entry:
            if value is None or _ONLY_HERE.get(entry["only_in"]) is not value:
                raise ValueError(
                    f"{made}, which only the process that made it had: train again with a {name} "
                    "that is defined at the top of a file"
                )
            continue
        if name in given and reference_to(value) != path:
            raise ValueError(f"{made}, got {reference_to(value)}: pass the first")
        if not is_of_package(value) and digest_of(value) != entry["sha256"]:
            raise ValueError(f"{made}, whose source has changed since: restore it")
        if "repr" in entry and (text := instance_text(value)) != entry["repr"]:
            raise ValueError(
                f"{where} was made with {name}={entry['repr']}, got {text}: pass the first"
            )
    for name, value in given.items():
        if name not in recorded:
            raise ValueError(
                f"{where} was made without {name}=, got {reference_to(value)}: leave it out"
            )


def check_given_again(recorded: Record, given: Collection[str], where: str) -> None:
    """Rejects a configuration to start from that lacks an object which its run was passed.

    Args:
      recorded: the objects of the run.
      given: names of those that are given again, as `module:name`.
      where: the file of the configuration.

    Raises:
      ValueError: one is not given again.
    """
    for name, entry in recorded.items():
        if "given" in entry and name not in given:
            option, again = f"give --{name} MODULE:NAME", f"train from Python with {name}= again"
            give = option if name in ON_COMMAND_LINE else again
            raise ValueError(
                f"{where} is of a run that was passed {name}={entry['given']} from Python, which "
                f"the file does not hold: {give}"
            )


def _path(entry: Mapping[str, str]) -> str:
    return entry.get("given", entry.get("path", ""))


def _identity(name: str, value: Any) -> dict[str, str]:
    """What tells an object from others; see `record`."""
    if not has_lasting_source(value):
        token = uuid.uuid4().hex
        _ONLY_HERE[token] = value
        return {"only_in": token}
    # The configuration says which environment it is.
    text = "" if name == "env" else instance_text(value)
    return {"sha256": digest_of(value)} | ({"repr": text} if text else {})


def _named(config: TrainConfig) -> dict[str, str]:
    """What a configuration names that is not part of the package: its import path by its role."""
    named = {"reward": config.env.reward, "network": config.network.network}
    found = {name: text for name, text in named.items() if is_reference(text)}
    make = find_task(config.env.task).make
    if not is_of_package(make):
        task = config.env.task
        found["task"] = task if is_reference(task) else reference_to(make)
    return found


def _find(name: str, path: str, config: TrainConfig, objects: Objects) -> Any:
    """The object of a role: as it was passed, or as the configuration or the environment has it."""
    given = objects.given()
    if name in given:
        return given[name]
    if name == "task":
        return find_task(config.env.task).make
    reward = getattr(objects.env, "reward", None)
    if name == "reward" and reward is not None:
        return reward
    return load_reference(path, name)
