"""Checkpoints on disk, by orbax: written whole or not at all, the last two and the best kept."""

from __future__ import annotations

import contextlib
import gc
import pathlib
import shutil
import warnings
from typing import Any

import jax

_KEPT = 2
_DIGITS = 12
_READ_ERRORS = (ValueError, KeyError, TypeError, OSError)


def save_tree(path: pathlib.Path, tree: Any) -> None:
    """Writes a pytree of arrays to a folder; an interrupted write leaves no such folder.

    Raises:
      ValueError: the disk is full, or the folder cannot be written.
    """
    # orbax and tensorstore are the heaviest part of the install: only who saves loads them.
    import orbax.checkpoint as ocp

    try:
        with ocp.StandardCheckpointer() as checkpointer:
            checkpointer.save(path.absolute(), _to_data(tree), force=True)
    except (OSError, ValueError) as error:
        reason = " ".join(str(error).split())[:200]
        raise ValueError(f"the checkpoint {path} could not be written: {reason}") from error


def load_tree(path: pathlib.Path, like: Any) -> Any:
    """Reads a pytree with the structure, shapes and dtypes of `like`.

    Raises:
      ValueError: there is no checkpoint, or it is damaged, or of something else.
    """
    import orbax.checkpoint as ocp

    if not path.is_dir():
        raise ValueError(f"{path} is not a checkpoint")
    data = None
    with ocp.StandardCheckpointer() as checkpointer, contextlib.suppress(*_READ_ERRORS):
        data = checkpointer.restore(path.absolute(), _to_data(like))
    if data is None:
        # A failed read leaves its other coroutines un-awaited, of which Python would complain.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)
            gc.collect()
        raise ValueError(f"{path} is damaged, or not a checkpoint of such a run")
    return _from_data(data, like)


class RunCheckpoints:
    """The checkpoints of a run folder, by the number of vector steps that they were taken after."""

    def __init__(self, folder: pathlib.Path):
        self._folder = folder / "checkpoints"

    def save(self, vector_step: int, state: Any) -> None:
        """Writes a checkpoint, then removes all but the last two."""
        save_tree(self._folder / f"{vector_step:0{_DIGITS}d}", state)
        for step in self.steps()[:-_KEPT]:
            shutil.rmtree(self._folder / f"{step:0{_DIGITS}d}")

    def steps(self) -> list[int]:
        """Vector steps of the checkpoints there are, the oldest first."""
        if not self._folder.is_dir():
            return []
        names = (path.name for path in self._folder.iterdir())
        return sorted(int(name) for name in names if len(name) == _DIGITS and name.isdigit())

    def load_newest(self, like: Any) -> tuple[Any, int]:
        """Reads the newest checkpoint.

        Raises:
          ValueError: there is none, or it is damaged; names the newest whole one, if there is one.
        """
        steps = self.steps()
        if not steps:
            raise ValueError(f"{self._folder} holds no checkpoint to go on from")
        try:
            return self.load(steps[-1], like), steps[-1]
        except ValueError as error:
            for step in reversed(steps[:-1]):
                try:
                    self.load(step, like)
                except ValueError:
                    continue
                raise ValueError(
                    f"{error}; remove it to go on from the one before, {step:0{_DIGITS}d}"
                ) from error
            raise

    def load(self, step: int, like: Any) -> Any:
        """Reads one checkpoint.

        Raises:
          ValueError: it is damaged, or of another run.
        """
        return load_tree(self._folder / f"{step:0{_DIGITS}d}", like)


def _is_key(leaf: Any) -> bool:
    return bool(jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key))


def _to_data(tree: Any) -> Any:
    """PRNG keys, which orbax does not know, as the arrays behind them."""

    def convert(leaf: Any) -> Any:
        if not _is_key(leaf):
            return leaf
        if isinstance(leaf, jax.ShapeDtypeStruct):
            return jax.eval_shape(jax.random.key_data, leaf)
        return jax.random.key_data(leaf)

    return jax.tree.map(convert, tree)


def _from_data(data: Any, like: Any) -> Any:
    return jax.tree.map(
        lambda x, wanted: jax.random.wrap_key_data(x) if _is_key(wanted) else x, data, like
    )
