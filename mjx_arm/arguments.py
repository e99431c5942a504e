"""Reads the options of a command line by their annotations, with errors of one sentence."""

from __future__ import annotations

import pathlib
import types
import typing
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal

from mjx_arm.options import check_name, check_value, describe


def read_arguments(
    arguments: Sequence[str], known: Mapping[str, Any]
) -> tuple[dict[str, Any], list[str]]:
    """Reads `--name value`, `--name=value`, `--flag` and `--no-flag`.

    Args:
      arguments: what follows the command.
      known: names of the options, as in Python, and their annotations.

    Returns:
      The values by name, and the arguments that belong to no option.

    Raises:
      ValueError: an unknown option, or a value that the option does not take.
    """
    values: dict[str, Any] = {}
    others: list[str] = []
    left = list(arguments)
    while left:
        argument = left.pop(0)
        if not argument.startswith("--"):
            others.append(argument)
            continue
        option, equals, text = argument.partition("=")
        name, on = _find(option, known)
        annotation = known[name]
        if annotation is bool:
            if equals:
                raise ValueError(f"{option} takes no value, got {text!r}")
            values[name] = on
            continue
        texts = [text] if equals else []
        while left and len(texts) < _most_texts(annotation) and not left[0].startswith("--"):
            texts.append(left.pop(0))
        values[name] = read_value(option, name, annotation, texts)
    return values, others


def _find(option: str, known: Mapping[str, Any]) -> tuple[str, bool]:
    """The name of an option, and whether it turns that on."""
    name = option[2:].replace("-", "_")
    off = name.removeprefix("no_")
    if name not in known and known.get(off) is bool:
        return off, False
    flags = [x.replace("_", "-") for x in known]
    check_name("option", name.replace("_", "-"), flags, prefix="--")
    return name, True


def _most_texts(annotation: Any) -> float:
    """How many arguments an option takes at most."""
    origin, parts = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is Annotated:
        return _most_texts(parts[0])
    if origin in (typing.Union, types.UnionType):
        return max(_most_texts(part) for part in parts)
    if origin is tuple:
        return float("inf") if parts[-1] is Ellipsis else len(parts)
    return 1


def read_value(option: str, name: str, annotation: Any, texts: list[str]) -> Any:
    """The value that texts mean for an option.

    Args:
      option: what errors call it.
      name: of the option.
      annotation: what it may be.
      texts: as they stand on the command line.

    Raises:
      ValueError: they mean no value that is allowed.
    """
    try:
        value = _read(annotation, texts)
    except (ValueError, OverflowError):
        got = repr(" ".join(texts)) if texts else "nothing"
        raise ValueError(f"{option} must be {describe(annotation)}, got {got}") from None
    check_value(name, annotation, value)
    return value


def _read(annotation: Any, texts: list[str]) -> Any:
    """The value that texts mean; ValueError where they mean none."""
    origin, parts = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is Annotated:
        return _read(parts[0], texts)
    if origin in (typing.Union, types.UnionType):
        return _read_first(parts, texts)
    if origin is tuple:
        items = [parts[0]] * len(texts) if parts[-1] is Ellipsis else parts
        return tuple(_read(item, [text]) for item, text in zip(items, texts, strict=True))
    (text,) = texts
    if origin is Literal:
        return _read_choice(parts, text)
    if annotation is type(None):
        return _read_choice((None,), text)
    reader: Any = annotation if annotation in (int, float, str, pathlib.Path) else str
    return reader(text)


def _read_first(annotations: Sequence[Any], texts: list[str]) -> Any:
    """What the first annotation that can reads; None before others, or it would be text."""
    for annotation in sorted(annotations, key=lambda x: x is not type(None)):
        try:
            return _read(annotation, texts)
        except ValueError:
            continue
    raise ValueError


def _read_choice(choices: Sequence[Any], text: str) -> Any:
    for choice in choices:
        if str(choice) == text:
            return choice
    raise ValueError
