"""A user's own objects in a run: recorded by import path and digest of their source."""

from __future__ import annotations

import dataclasses
import uuid
from typing import Any

from mjx_arm.config import TrainConfig
from mjx_arm.envs.tasks import find_task
from mjx_arm.references import has_lasting_source, is_reference, load_reference, reference_to
from mjx_arm.references import source_digest as digest_of

Record = dict[str, dict[str, str]]

# Objects that only this process has, such as lambdas, by the token that a record has of them.
_ONLY_HERE: dict[str, Any] = {}


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

    An object that no other process can have, such as a lambda, has a token in place of the digest.
    """
    found = {}
    for name, value in objects.given().items():
        path = reference_to(value)
        if has_lasting_source(value):
            found[name] = {"given": path, "sha256": digest_of(value)}
        else:
            token = uuid.uuid4().hex
            _ONLY_HERE[token] = value
            found[name] = {"given": path, "only_in": token}
    for name, path in _references(config).items():
        if name not in found:
            found[name] = {"path": path, "sha256": digest_of(_load(name, path))}
    return found


def only_here(recorded: Record) -> list[str]:
    """A sentence about each object that no other process can have."""
    return [
        f"{name} is {entry['given']}, which no other process can have: this run cannot be resumed, "
        "nor its agent be loaded, after this process has ended; to keep them, define it at the top "
        "of a file"
        for name, entry in recorded.items()
        if "only_in" in entry
    ]


def check_record(recorded: Record, config: TrainConfig, objects: Objects, where: str) -> None:
    """Refuses objects that are not those of the record.

    Raises:
      ValueError: one is missing, or another one, or its source has changed.
    """
    given = objects.given()
    for name, entry in recorded.items():
        path = entry.get("given", entry.get("path", ""))
        if "only_in" in entry:
            if name not in given or _ONLY_HERE.get(entry["only_in"]) is not given[name]:
                raise ValueError(
                    f"{where} was made with {name}={path}, which only the process that made it "
                    f"had: train again with a {name} that is defined at the top of a file"
                )
            continue
        if "given" in entry and name not in given:
            raise ValueError(f"{where} was made with {name}={path}: pass it again as {name}=")
        value = given[name] if name in given else _load(name, path)
        if name in given and reference_to(value) != path:
            raise ValueError(
                f"{where} was made with {name}={path}, got {reference_to(value)}: pass the first"
            )
        if digest_of(value) != entry["sha256"]:
            raise ValueError(
                f"{where} was made with {name}={path}, whose source has changed since: restore it"
            )
    for name, value in given.items():
        if name not in recorded:
            raise ValueError(
                f"{where} was made without {name}=, got {reference_to(value)}: leave it out"
            )


def _references(config: TrainConfig) -> dict[str, str]:
    named = {
        "reward": config.env.reward,
        "network": config.network.network,
        "task": config.env.task,
    }
    return {name: text for name, text in named.items() if is_reference(text)}


def _load(name: str, path: str) -> Any:
    if name == "task":
        return find_task(path).make
    return load_reference(path, name)
