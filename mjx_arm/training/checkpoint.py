"""Checkpoints on disk, by orbax: whole or not there at all, and the last two of a run kept."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import pathlib
import shutil
import tempfile
import threading
import zlib
from collections.abc import Iterator
from typing import Any

import jax

from mjx_arm.training.memory import tree_size

_KEPT = 2
_DIGITS = 12
_MANIFEST = "manifest.json"


def save_tree(path: pathlib.Path, tree: Any) -> None:
    """Writes a pytree of arrays to a folder, and last a manifest without which it does not count.

    Raises:
      ValueError: the disk is full, or the folder cannot be written.
    """
    # orbax and tensorstore are the heaviest part of the install: only who saves loads them.
    import orbax.checkpoint as ocp

    try:
        _check_room(path.parent, tree_size(tree))
        with _without_tracebacks(), ocp.StandardCheckpointer() as checkpointer:
            checkpointer.save(path.absolute(), _to_data(tree), force=True)
        manifest = {"files": _checksums(path), "arrays": _describe(tree)}
        part = path / f"{_MANIFEST}.part"
        part.write_text(json.dumps(manifest))
        part.replace(path / _MANIFEST)
    except (OSError, ValueError) as error:
        for left in path.parent.glob(f"{path.name}.orbax-checkpoint-tmp*"):
            shutil.rmtree(left, ignore_errors=True)
        reason = " ".join(str(error).split())[:200]
        raise ValueError(f"the checkpoint {path} could not be written: {reason}") from error


def _check_room(folder: pathlib.Path, size: int) -> None:
    """Takes `size` bytes of the disk and gives them back.

    A write of orbax that fails prints tracebacks from threads that nothing here can reach.
    """
    if not hasattr(os, "posix_fallocate"):
        return
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryFile(dir=folder) as file:
        os.posix_fallocate(file.fileno(), 0, size)


@contextlib.contextmanager
def _without_tracebacks() -> Iterator[None]:
    """Keeps orbax from telling of a failure thread by thread: it raises it as well."""
    hook = threading.excepthook
    loggers = [logging.getLogger(name) for name in ("absl", "asyncio")]
    before = [logger.disabled for logger in loggers]
    threading.excepthook = lambda args: None
    for logger in loggers:
        logger.disabled = True
    try:
        yield
    finally:
        threading.excepthook = hook
        for logger, disabled in zip(loggers, before, strict=True):
            logger.disabled = disabled


def load_tree(path: pathlib.Path, like: Any) -> Any:
    """Reads a pytree with the structure, shapes and dtypes of `like`.

    Raises:
      ValueError: there is no checkpoint, or it is damaged, or of something else.
    """
    import orbax.checkpoint as ocp

    # A read that fails half-way leaves orbax with coroutines to complain of.
    check_tree(path, like)
    with ocp.StandardCheckpointer() as checkpointer:
        return _from_data(checkpointer.restore(path.absolute(), _here(_to_data(like))), like)


def check_tree(path: pathlib.Path, like: Any) -> None:
    """Refuses what `load_tree` could not read.

    Raises:
      ValueError: there is no checkpoint, or it is damaged, or of something else.
    """
    if not (path / _MANIFEST).is_file():
        raise ValueError(f"{path} is not a checkpoint, or not a whole one")
    files, arrays = _read_manifest(path)
    if files != _checksums(path):
        raise ValueError(f"{path} is damaged: its files are not those that were written")
    if arrays != _describe(like):
        raise ValueError(f"{path} is not a checkpoint of such a run")


def _read_manifest(path: pathlib.Path) -> tuple[Any, Any]:
    """The checksums of a checkpoint's files and its arrays, None where the manifest has none."""
    try:
        manifest = json.loads((path / _MANIFEST).read_text())
    except (json.JSONDecodeError, UnicodeDecodeError):
        manifest = None
    if not isinstance(manifest, dict):
        return None, None
    return manifest.get("files"), manifest.get("arrays")


def _checksums(path: pathlib.Path) -> dict[str, int]:
    """CRC-32 of each file of a checkpoint, but for the manifest."""
    files = (file for file in path.rglob("*") if file.is_file())
    return {
        str(file.relative_to(path)): zlib.crc32(file.read_bytes())
        for file in files
        if not file.name.startswith(_MANIFEST)
    }


def _describe(tree: Any) -> list[str]:
    """Path, shape and dtype of each array."""
    leaves = jax.tree_util.tree_flatten_with_path(tree)[0]
    return [f"{jax.tree_util.keystr(p)} {x.shape} {x.dtype}" for p, x in leaves]


class RunCheckpoints:
    """The checkpoints of a run folder, by the number of vector steps that they were taken after."""

    def __init__(self, folder: pathlib.Path):
        self.folder = folder / "checkpoints"

    def save(self, vector_step: int, state: Any) -> None:
        """Writes a checkpoint, then removes all but the last two.

        Raises:
          ValueError: it could not be written.
        """
        path = self._path(vector_step)
        try:
            save_tree(path, state)
        except ValueError:
            shutil.rmtree(path, ignore_errors=True)
            raise
        for step in self.steps()[:-_KEPT]:
            shutil.rmtree(self._path(step))

    def steps(self) -> list[int]:
        """Vector steps of the checkpoints there are, the oldest first."""
        if not self.folder.is_dir():
            return []
        whole = (path for path in self.folder.iterdir() if (path / _MANIFEST).is_file())
        names = (path.name for path in whole)
        return sorted(int(name) for name in names if len(name) == _DIGITS and name.isdigit())

    def newest(self) -> str | None:
        """Name of the newest whole checkpoint, if there is one."""
        steps = self.steps()
        return f"{steps[-1]:0{_DIGITS}d}" if steps else None

    def find_newest(self, like: Any) -> int:
        """The vector step of the newest checkpoint, which `load` can read.

        Raises:
          ValueError: there is none, or it is damaged; names the newest whole one, if there is one.
        """
        steps = self.steps()
        if not steps:
            raise ValueError(f"{self.folder} holds no checkpoint to continue from")
        try:
            check_tree(self._path(steps[-1]), like)
            return steps[-1]
        except ValueError as error:
            for step in reversed(steps[:-1]):
                try:
                    check_tree(self._path(step), like)
                except ValueError:
                    continue
                raise ValueError(
                    f"{error}; remove it to continue from the one before, {step:0{_DIGITS}d}"
                ) from error
            raise

    def load(self, step: int, like: Any) -> Any:
        """Reads one checkpoint.

        Raises:
          ValueError: it is damaged, or of another run.
        """
        return load_tree(self._path(step), like)

    def _path(self, step: int) -> pathlib.Path:
        return self.folder / f"{step:0{_DIGITS}d}"


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


def _here(tree: Any) -> Any:
    """Shapes and dtypes on this machine's device; the checkpoint's own may not be here."""
    device = jax.sharding.SingleDeviceSharding(jax.devices()[0])
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=device), tree)


def _from_data(data: Any, like: Any) -> Any:
    return jax.tree.map(
        lambda x, wanted: jax.random.wrap_key_data(x) if _is_key(wanted) else x, data, like
    )
