"""Parameters on disk, by orbax, written whole or not at all."""

from __future__ import annotations

import pathlib
from typing import Any


def save_params(path: pathlib.Path, params: Any) -> None:
    """Writes a pytree of arrays to a new folder; an interrupted write leaves no such folder."""
    # orbax and tensorstore are the heaviest part of the install: only who saves loads them.
    import orbax.checkpoint as ocp

    with ocp.StandardCheckpointer() as checkpointer:
        checkpointer.save(path.absolute(), params, force=True)


def load_params(path: pathlib.Path, like: Any) -> Any:
    """Reads parameters with the structure, shapes and dtypes of `like`.

    Raises:
      ValueError: there is no checkpoint, or it is not of such parameters.
    """
    import orbax.checkpoint as ocp

    if not path.is_dir():
        raise ValueError(f"{path} is not a checkpoint of parameters")
    try:
        with ocp.StandardCheckpointer() as checkpointer:
            return checkpointer.restore(path.absolute(), like)
    except (ValueError, KeyError, FileNotFoundError) as error:
        raise ValueError(f"{path} does not hold the parameters of this network") from error
