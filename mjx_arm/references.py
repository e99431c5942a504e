"""Objects of a user's own, by import path: `module:name`, and a digest of their source."""

from __future__ import annotations

import functools
import hashlib
import importlib
import inspect
import pathlib
import re
import sys
from typing import Any

_LOCAL = ("<lambda>", "<locals>")


def is_reference(text: object) -> bool:
    """Whether a value is a text of the form `module:name`."""
    return isinstance(text, str) and ":" in text


def reference_to(value: Any) -> str:
    """`module:name` of a function or class; of another object, that of its class."""
    named = value if hasattr(value, "__qualname__") else type(value)
    return f"{named.__module__}:{named.__qualname__}"


def has_lasting_source(value: Any) -> bool:
    """Whether another process can have the same object: it has a name of its own in a file.

    It cannot have a lambda, a function inside a function or a `functools.partial`: the values that
    these enclose are not in their source.
    """
    if isinstance(value, functools.partial) or any(part in reference_to(value) for part in _LOCAL):
        return False
    try:
        source_digest(value)
    except ValueError:
        return False
    return True


def is_of_package(value: Any) -> bool:
    """Whether an object is defined in this package; of a `functools.partial`, its function."""
    while isinstance(value, functools.partial):
        value = value.func
    return reference_to(value).split(":")[0].split(".")[0] == __name__.split(".")[0]


def instance_text(value: Any) -> str:
    """What an instance, or the object of a bound method, says of its values, in one line.

    Empty for functions and classes, which their source describes. Without addresses in memory, so
    that every process says the same of the same values.
    """
    if inspect.isfunction(value) or inspect.isclass(value):
        return ""
    return " ".join(re.sub(r" at 0x[0-9a-fA-F]+", "", repr(value)).split())


def load_module(name: str, what: str) -> Any:
    """Imports a module, which may also be in the working directory.

    Args:
      name: its import path.
      what: what it is for, for the error.

    Raises:
      ValueError: it cannot be imported.
    """
    here = str(pathlib.Path.cwd())
    added = here not in sys.path
    if added:
        sys.path.insert(0, here)
    try:
        return importlib.import_module(name)
    except Exception as error:  # whatever a user's module raises while it is imported
        reason = " ".join(str(error).split())
        raise ValueError(
            f"{what}: module {name!r} cannot be imported ({type(error).__name__}: {reason}); "
            "give a module in the working directory or on the Python path"
        ) from error
    finally:
        if added:
            sys.path.remove(here)


def load_reference(reference: str, what: str) -> Any:
    """Imports the object that `module:name` names.

    Args:
      reference: the import path.
      what: what the object is, for the error.

    Raises:
      ValueError: the module cannot be imported, or lacks the name.
    """
    module_name, _, name = reference.partition(":")
    value: Any = load_module(module_name, what)
    for part in name.split("."):
        if not hasattr(value, part):
            raise ValueError(f"{what}: module {module_name!r} has no {name!r}")
        value = getattr(value, part)
    return value


def source_digest(value: Any) -> str:
    """SHA-256 of the source of a function or class, or of the class of another object.

    Raises:
      ValueError: the source is not in a file.
    """
    named = value if hasattr(value, "__qualname__") else type(value)
    try:
        source = inspect.getsource(named)
    except (OSError, TypeError) as error:
        raise ValueError(
            f"the source of {reference_to(value)!r} is not in a file: define it in a module"
        ) from error
    return hashlib.sha256(inspect.cleandoc(source).encode()).hexdigest()
