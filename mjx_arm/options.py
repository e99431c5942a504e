"""Validated options: frozen dataclasses that pydantic checks, with errors of one sentence.

`@options` makes a class of options. Every value is checked when an object is made, also by
`dataclasses.replace`: types are strict (2.0 is no whole number, True is no number), numbers are
finite, unknown names are rejected with the nearest known one.
"""

from __future__ import annotations

import dataclasses
import difflib
import functools
import pathlib
import types
import typing
from collections.abc import Iterable, Mapping
from typing import Annotated, Any, Literal, TypeVar, dataclass_transform

import annotated_types
import numpy as np
import pydantic
import pydantic.dataclasses
from pydantic import Field

T = TypeVar("T")
C = TypeVar("C", bound=type)

# Counts are 32 bits wide.
MOST = 2**31 - 1

Count = Annotated[int, Field(ge=1, le=MOST)]
CountOrZero = Annotated[int, Field(ge=0, le=MOST)]
Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Share = Annotated[float, Field(ge=0, le=1)]
Discount = Annotated[float, Field(gt=0, le=1)]
Size = tuple[Count, Count]

_STRICT = pydantic.ConfigDict(strict=True, extra="forbid", allow_inf_nan=False)
# More names than this are not listed in an error.
_MOST_LISTED = 30
_NUMBER_WORDS = ("no", "one", "two", "three", "four", "five", "six")


@dataclass_transform(frozen_default=True, kw_only_default=True)
def options(cls: C) -> C:
    """Makes a frozen, keyword-only, validated dataclass of a class.

    Its constructor raises ValueError with one sentence that names the field, what is allowed and
    what was given. A method `check` is called last, for what involves several fields; it raises
    ValueError.
    """
    made: Any = pydantic.dataclasses.dataclass(frozen=True, kw_only=True, config=_STRICT)(cls)
    validate = made.__init__

    @functools.wraps(validate)
    def init(self: Any, *args: Any, **values: Any) -> None:
        if args:
            raise ValueError(f"{made.__name__} takes its options by name, got {args[0]!r}")
        for name in values:
            check_name("option", name, option_names(made))
        try:
            validate(self, **values)
        except pydantic.ValidationError as error:
            raise ValueError(_sentence(made, values, error)) from None
        for name in option_names(made):
            try:
                hash(getattr(self, name))
            except TypeError:
                raise ValueError(
                    f"{name} must be of a type that can be hashed, such as a tuple instead of a "
                    f"list, got {type(getattr(self, name)).__name__}"
                ) from None
        check = getattr(self, "check", None)
        if check is not None:
            check()

    made.__init__ = init
    return typing.cast(C, made)


def _sentence(cls: type, values: Mapping[str, Any], error: pydantic.ValidationError) -> str:
    name = str(error.errors()[0]["loc"][0])
    return invalid(name, _annotations(cls)[name], values.get(name))


def check_value(name: str, annotation: Any, value: Any) -> None:
    """Rejects an argument that its annotation does not allow, as for an option.

    Raises:
      ValueError: says what is allowed and what was given.
    """
    plain = value.item() if isinstance(value, np.generic) else value
    try:
        _adapter(annotation).validate_python(plain)
    except pydantic.ValidationError:
        raise ValueError(invalid(name, annotation, value)) from None


@functools.cache
def _adapter(annotation: Any) -> pydantic.TypeAdapter:
    strict = pydantic.ConfigDict(strict=True, allow_inf_nan=False, arbitrary_types_allowed=True)
    return pydantic.TypeAdapter(annotation, config=strict)


def invalid(name: str, annotation: Any, value: Any) -> str:
    """The sentence about a value that an option does not take."""
    too_large = type(value) is int and value > MOST
    limit = f" and at most {MOST}" if too_large else ""
    return f"{name} must be {describe(annotation)}{limit}, got {_show(value)}"


def _show(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:77]}..."


def describe(annotation: Any) -> str:
    """What values a type allows, in words: `"a whole number of at least 1"`."""
    if isinstance(annotation, typing.TypeAliasType if hasattr(typing, "TypeAliasType") else ()):
        return describe(annotation.__value__)
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is Annotated:
        return describe(arguments[0]) + _bounds(arguments[1:], whole=arguments[0] is int)
    if origin is Literal:
        return f"one of {', '.join(str(value) for value in arguments)}"
    if origin in (typing.Union, types.UnionType):
        return " or ".join(describe(argument) for argument in arguments)
    if origin is tuple:
        if arguments[-1] is Ellipsis:
            return f"a tuple, each item {describe(arguments[0])}"
        count = _NUMBER_WORDS[len(arguments)]
        return f"a tuple of {count} values, each {describe(arguments[0])}"
    words = {
        int: "a whole number",
        float: "a finite number",
        bool: "true or false",
        str: "text",
        pathlib.Path: "a path",
        type(None): "None",
    }
    if annotation in words:
        return words[annotation]
    return f"of type {getattr(annotation, '__name__', annotation)}"


def _bounds(metadata: Iterable[Any], whole: bool) -> str:
    bounds: dict[str, Any] = {}
    for item in metadata:
        for part in getattr(item, "metadata", [item]):
            for kind, name in (
                (annotated_types.Ge, "ge"),
                (annotated_types.Gt, "gt"),
                (annotated_types.Le, "le"),
                (annotated_types.Lt, "lt"),
            ):
                if isinstance(part, kind):
                    bounds[name] = getattr(part, name)
    if "ge" in bounds and "le" in bounds and bounds["le"] != MOST:
        return f" from {bounds['ge']} to {bounds['le']}"
    said = []
    words = {"ge": "of at least", "gt": "above", "le": "of at most", "lt": "below"}
    for name, bound in bounds.items():
        if bound != MOST or name != "le":
            said.append(f"{words[name]} {bound}")
    if not said and whole and bounds:
        return f" of at most {MOST}"
    return f" {' and '.join(said)}" if said else ""


def option_names(cls: type) -> list[str]:
    """Names of the fields of a class of options."""
    return [field.name for field in dataclasses.fields(cls)]


@functools.cache
def _annotations(cls: type) -> dict[str, Any]:
    return typing.get_type_hints(cls, include_extras=True)


def _fields_of(cls: Any) -> dict[str, Any]:
    return _annotations(cls)


def check_name(what: str, name: str, known: Iterable[str], *, prefix: str = "") -> None:
    """Rejects an unknown name, and offers the nearest known one.

    Args:
      what: what the name is of.
      name: the name.
      known: all names.
      prefix: what stands before each name where a user types it.

    Raises:
      ValueError: `name` is not in `known`.
    """
    if not isinstance(name, str):
        raise ValueError(invalid(what, str, name))
    names = list(known)
    if name in names:
        return
    near = difflib.get_close_matches(str(name), names, n=1, cutoff=0.6)
    if near:
        offer = f"did you mean {prefix + near[0]!r}?"
    elif len(names) > _MOST_LISTED:
        offer = "see --help"
    else:
        offer = f"known are {', '.join(prefix + known for known in names)}"
    raise ValueError(f"unknown {what} {prefix + name!r}: {offer}")


def flat_names(config: Any) -> dict[str, tuple[str, ...]]:
    """Where each option of nested options is: its name -> the names of the fields that lead there.

    Names are unique across the groups; a test asserts it.
    """
    places: dict[str, tuple[str, ...]] = {}
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if dataclasses.is_dataclass(value):
            inner = flat_names(value)
            places |= {name: (field.name, *path) for name, path in inner.items()}
        else:
            places[field.name] = (field.name,)
    return places


def flat_annotations(config: Any) -> dict[str, Any]:
    """The annotation of each option of nested options, by its name alone."""
    found: dict[str, Any] = {}
    for name, annotation in _fields_of(type(config)).items():
        value = getattr(config, name)
        found |= flat_annotations(value) if dataclasses.is_dataclass(value) else {name: annotation}
    return found


def get_option(config: Any, name: str) -> Any:
    """The value of an option in nested options, by its name alone."""
    places = flat_names(config)
    check_name("option", name, places)
    return functools.reduce(getattr, places[name], config)


def set_options(config: T, values: Mapping[str, Any], groups: Mapping[str, Any] | None = None) -> T:
    """The same options with some changed, each named without its group.

    Lists count as tuples. Only the result is checked, whatever the order of the changes.

    Args:
      config: the options.
      values: new values by name.
      groups: nested options that replace those of the same field first.

    Raises:
      ValueError: an unknown name, or a value that the option does not take.
    """
    groups = {} if groups is None else groups
    places = {name: path for name, path in flat_names(config).items() if path[0] not in groups}
    for group, options in groups.items():
        places |= {name: (group, *path) for name, path in flat_names(options).items()}
    changes: dict[str, dict[str, Any]] = {}
    own: dict[str, Any] = dict(groups)
    for name, value in values.items():
        check_name("option", name, places)
        value = tuple(value) if isinstance(value, list) else value
        path = places[name]
        if len(path) == 1:
            own[name] = value
        else:
            changes.setdefault(path[0], {})[name] = value
    for group, inner in changes.items():
        before = groups[group] if group in groups else getattr(config, group)
        own[group] = set_options(before, inner)
    return dataclasses.replace(config, **own) if own else config  # type: ignore[type-var]


def to_json(config: Any) -> dict[str, Any]:
    """Options as a JSON object; nested options become nested objects."""
    return dataclasses.asdict(config)


def from_json(cls: type[T], values: Any, where: str, nested: Mapping[str, type] = {}) -> T:
    """Options from a JSON object that `to_json` made.

    Args:
      cls: the class of the options.
      values: the object.
      where: what an error says the object is, such as a file and the name of a group.
      nested: for fields that hold options of a class that their annotation does not name, the
        class.

    Raises:
      ValueError: unknown or missing names, or a value that the option does not take.
    """
    if not isinstance(values, dict):
        raise ValueError(f"{where} must be an object with options, got {_show(values)}")
    given: dict[str, Any] = {}
    for name, value in values.items():
        try:
            check_name("option", name, option_names(cls))
        except ValueError as error:
            raise ValueError(f"{where} has an {error}") from None
        inner: Any = nested.get(name, _fields_of(cls)[name])
        if dataclasses.is_dataclass(inner):
            given[name] = from_json(typing.cast(type, inner), value, f"{where}, {name!r}")
        else:
            given[name] = _tuples(value)
    try:
        return cls(**given)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from None


def _tuples(value: Any) -> Any:
    return tuple(_tuples(item) for item in value) if isinstance(value, list) else value
