"""Options that a sweep varies, and the values that each may have."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

from mjx_arm.arguments import read_value
from mjx_arm.config import TrainConfig, set_train_options
from mjx_arm.options import check_name, flat_annotations, flat_names

_HOW = "give NAME=LOW..HIGH, NAME=LOW..HIGH:log or NAME=VALUE,VALUE,..."
# What the sweep itself sets, or what would make trials incomparable.
_FIXED = ("num_seeds", "seed", "select_episodes", "select_every", "total_steps")


@dataclasses.dataclass(frozen=True)
class Dimension:
    """An option that a sweep varies.

    Attributes:
      name: of the option.
      low: least value; None where there are choices.
      high: largest value.
      log: values are sampled uniformly on a logarithmic scale.
      choices: values to choose from; empty where there is a range.
    """

    name: str
    low: Any = None
    high: Any = None
    log: bool = False
    choices: tuple[Any, ...] = ()


def parse_space(texts: Sequence[str], config: TrainConfig) -> tuple[Dimension, ...]:
    """Reads `learning-rate=1e-4..1e-2:log`, `n-step=1..5` and `hidden=128,256`.

    Args:
      texts: one for each option.
      config: the options that the sweep starts from.

    Raises:
      ValueError: there is none, an option is unknown, given twice or not to be varied, or one of
        the values is not allowed for it.
    """
    if not texts:
        raise ValueError(f"--search needs at least one option to vary: {_HOW}")
    space = tuple(_parse(text, config) for text in texts)
    names = [dimension.name for dimension in space]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"--search names {name.replace('_', '-')} twice: give it once")
    return space


def _parse(text: str, config: TrainConfig) -> Dimension:
    option, equals, values = text.partition("=")
    name = option.replace("-", "_")
    if not equals or not values:
        raise ValueError(f"--search cannot read {text!r}: {_HOW}")
    check_name("option in --search:", name, flat_names(config))
    if name in _FIXED:
        raise ValueError(f"--search cannot vary {option}: trials would not be comparable")
    annotation = flat_annotations(config)[name]
    bounds, _, scale = values.partition(":")
    if ".." not in bounds:
        choices = tuple(read_value(option, name, annotation, [x]) for x in values.split(","))
        return Dimension(name, choices=choices)
    low, high = (read_value(option, name, annotation, [x]) for x in bounds.split("..", 1))
    if type(low) is not type(high) or not isinstance(low, int | float) or not low < high:
        raise ValueError(f"--search {option}: {bounds} must be two numbers, the lower one first")
    if scale not in ("", "log") or (scale and low <= 0):
        raise ValueError(f"--search {option}: {values} is not a range: {_HOW}; log needs LOW > 0")
    return Dimension(name, low, high, scale == "log")


def check_space(space: Sequence[Dimension], config: TrainConfig) -> None:
    """Rejects a space of whose options one end alone does not fit the others.

    Raises:
      ValueError: it does not.
    """
    for dimension in space:
        for value in dimension.choices or (dimension.low, dimension.high):
            set_train_options(config, {dimension.name: value})


def suggest(trial: Any, space: Sequence[Dimension]) -> dict[str, Any]:
    """The values that an Optuna trial tries, by the names of the options."""
    values: dict[str, Any] = {}
    for dimension in space:
        if dimension.choices:
            values[dimension.name] = trial.suggest_categorical(dimension.name, dimension.choices)
            continue
        kind = "int" if isinstance(dimension.low, int) else "float"
        sample = getattr(trial, f"suggest_{kind}")
        values[dimension.name] = sample(
            dimension.name, dimension.low, dimension.high, log=dimension.log
        )
    return values
