"""Checkpoints on disk, by orbax: whole or not there at all, and the last two of a run kept.

A checkpoint is a folder with the arrays, `state`, and `manifest.json`, which says whose they are
and has a digest of each file.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import logging
import os
import pathlib
import shutil
import tempfile
import threading
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp

from mjx_arm.config import dump_config, parse_config
from mjx_arm.training.memory import tree_size
from mjx_arm.training.mesh import place
from mjx_arm.training.processes import is_writer, on_writer, wait_for_all
from mjx_arm.training.seal import is_sealed, seal

_KEPT = 2
_DIGITS = 12
_MANIFEST = "manifest.json"
_STATE = "state"
# What orbax writes beside the arrays, bytes.
_OVERHEAD = 4_000_000
# Options that may change when a run is resumed.
_FREE = ("total_steps",)


@dataclasses.dataclass(frozen=True)
class Origin:
    """What a checkpoint belongs to.

    Attributes:
      run_id: of the run.
      config: the run's options as a JSON object.
      scene: digest of the run's scene.
    """

    run_id: str
    config: dict[str, Any]
    scene: str


def save_tree(
    path: pathlib.Path, tree: Any, *, origin: Origin | None = None, step: int | None = None
) -> None:
    """Writes a pytree of arrays to a folder: whole, or not at all.

    With several processes all of them must call it, and see the same folder. Each writes its part
    of what is spread over them.

    Args:
      path: of the folder; what is there is replaced.
      tree: the arrays.
      origin: what the manifest says that they belong to.
      step: the vector step after which they were taken.

    Raises:
      ValueError: the disk is full, or the folder cannot be written.
    """
    part = path.with_name(f"{path.name}.part")

    def prepare() -> None:
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir(parents=True)
        _check_room(part, tree_size(tree) + _OVERHEAD)

    def complete() -> None:
        write_manifest(part, tree, origin=origin, step=step)
        shutil.rmtree(path, ignore_errors=True)
        part.replace(path)

    with _whole_or_none(path, part):
        _on_writer(prepare)
        _write_arrays(part / _STATE, tree)
        _on_writer(complete)


@contextlib.contextmanager
def _whole_or_none(path: pathlib.Path, part: pathlib.Path) -> Iterator[None]:
    """Removes what was written of a checkpoint when that fails, and says so in one sentence."""
    try:
        yield
    except (OSError, ValueError) as error:
        if is_writer():
            shutil.rmtree(part, ignore_errors=True)
        raise ValueError(f"the checkpoint {path} could not be written: {_reason(error)}") from error


def _on_writer(function: Callable[[], None]) -> None:
    """Runs a function in the process that writes; an OSError becomes a ValueError in all."""

    def run() -> None:
        try:
            function()
        except OSError as error:
            raise ValueError(_reason(error)) from error

    on_writer(run)


def _reason(error: Exception) -> str:
    return getattr(error, "strerror", None) or " ".join(str(error).split())[:200]


def _check_room(folder: pathlib.Path, size: int) -> None:
    """Takes `size` bytes of the disk and gives them back.

    A write of orbax that fails prints tracebacks from threads that nothing here can reach.
    """
    if not hasattr(os, "posix_fallocate"):
        return
    with tempfile.TemporaryFile(dir=folder) as file:
        os.posix_fallocate(file.fileno(), 0, size)


def _write_arrays(path: pathlib.Path, tree: Any) -> None:
    # orbax is the heaviest part of the install: only a save or a resume loads it.
    import orbax.checkpoint as ocp

    with _without_tracebacks(), ocp.StandardCheckpointer() as checkpointer:
        checkpointer.save(path.absolute(), _to_data(tree), force=True)


@contextlib.contextmanager
def _without_tracebacks() -> Iterator[None]:
    """Keeps orbax from reporting a failure from each thread: it raises the failure as well."""
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


def write_manifest(
    path: pathlib.Path, tree: Any, *, origin: Origin | None = None, step: int | None = None
) -> None:
    """Writes the manifest of a folder that holds the arrays of a tree; see `save_tree`."""
    manifest = {
        "step": step,
        "origin": None if origin is None else dataclasses.asdict(origin),
        "arrays": _describe(tree),
        "files": _digests(path),
    }
    (path / _MANIFEST).write_text(seal(manifest))


def load_tree(path: pathlib.Path, like: Any) -> Any:
    """Reads a pytree with the structure, shapes, dtypes and shardings of `like`.

    The shardings may differ from those that it was written with. With several processes all of them
    must call it.

    Raises:
      ValueError: there is no checkpoint, or it is damaged, or of something else.
    """
    import orbax.checkpoint as ocp

    # A read that fails half-way leaves orbax with coroutines to complain of.
    on_writer(lambda: check_tree(path, like))
    with ocp.StandardCheckpointer() as checkpointer:
        data = checkpointer.restore((path / _STATE).absolute(), _here(_to_data(like)))
    return _from_data(data, like)


def check_tree(
    path: pathlib.Path, like: Any, *, origin: Origin | None = None, step: int | None = None
) -> None:
    """Rejects what `load_tree` could not read, and what belongs to something else.

    Args:
      path: of the checkpoint.
      like: a tree of the same structure, shapes and dtypes.
      origin: what the checkpoint must belong to; None for anything.
      step: the vector step that it must be of; None for any.

    Raises:
      ValueError: there is no checkpoint, or it is damaged, or of something else.
    """
    if not (path / _MANIFEST).is_file():
        raise ValueError(f"{path} is not a checkpoint, or not a whole one")
    manifest = read_manifest(path)
    if manifest is None or manifest["files"] != _digests(path):
        raise ValueError(f"{path} is damaged: its files are not those that were written")
    if step is not None and manifest["step"] != step:
        raise ValueError(f"{path} must be the checkpoint of step {step}, got {manifest['step']}")
    if origin is not None:
        _check_origin(path, manifest["origin"], origin)
    if manifest["arrays"] != _describe(like):
        raise ValueError(f"{path} is not a checkpoint of such a run")


def _check_origin(path: pathlib.Path, made: dict[str, Any] | None, wanted: Origin) -> None:
    found = None if made is None else Origin(**made)
    if found is None or found.run_id != wanted.run_id:
        raise ValueError(f"{path} is a checkpoint of another run: restore the run's own")
    if found.scene != wanted.scene:
        raise ValueError(f"{path} was made in another scene than this run has")
    changed = config_differences(found.config, wanted.config)
    if changed:
        raise ValueError(f"{path} was made with other options: {changed}")


def config_differences(trained: dict[str, Any], given: dict[str, Any]) -> str:
    """In words, the options in which a configuration differs from a run's; empty if in none.

    An option that is newer than the run counts as having had its default.

    Args:
      trained: what the run was trained with, as a JSON object.
      given: what the configuration says now.
    """
    before, now = (_flat(json.loads(json.dumps(x))) for x in (_completed(trained), given))
    names = [name for name in before | now if name not in _FREE]
    return ", ".join(
        f"{name} was {before.get(name)} and is now {now.get(name)}"
        for name in names
        if before.get(name) != now.get(name)
    )


def _completed(config: dict[str, Any]) -> dict[str, Any]:
    """With the defaults of the options that it lacks; as it is where it is no configuration."""
    try:
        return dump_config(parse_config(json.dumps(config), "the checkpoint"))
    except ValueError:
        return config


def _flat(config: dict[str, Any]) -> dict[str, Any]:
    """Options by their names alone, which are unique across the groups."""
    flat: dict[str, Any] = {}
    for name, value in config.items():
        flat |= _flat(value) if isinstance(value, dict) else {name: value}
    return flat


def read_manifest(path: pathlib.Path) -> dict[str, Any] | None:
    """What the manifest of a checkpoint says, or None where it is damaged."""
    try:
        text = (path / _MANIFEST).read_text()
    except UnicodeDecodeError:
        return None
    if not is_sealed(text):
        return None
    manifest: dict[str, Any] = json.loads(text)
    return manifest


def _digests(path: pathlib.Path) -> dict[str, str]:
    """SHA-256 of each file of a checkpoint, but for the manifest."""
    digests = {}
    for file in sorted(path.rglob("*")):
        if file.is_file() and file.name != _MANIFEST:
            with file.open("rb") as opened:
                digest = hashlib.file_digest(opened, "sha256").hexdigest()
            digests[str(file.relative_to(path))] = digest
    return digests


def _describe(tree: Any) -> list[str]:
    """Path, shape and dtype of each array."""
    leaves = jax.tree_util.tree_flatten_with_path(tree)[0]
    return [f"{jax.tree_util.keystr(p)} {x.shape} {x.dtype}" for p, x in leaves]


class RunCheckpoints:
    """The checkpoints of a run folder, by the number of vector steps that they were taken after.

    With an `origin` those that belong to something else are rejected.
    """

    def __init__(self, folder: pathlib.Path, origin: Origin | None = None):
        self.folder = folder / "checkpoints"
        self._origin = origin

    def save(self, vector_step: int, state: Any) -> None:
        """Writes a checkpoint, then removes all but the last two, and those that are not whole.

        Raises:
          ValueError: it could not be written.
        """
        save_tree(self._path(vector_step), state, origin=self._origin, step=vector_step)
        if is_writer():
            for step in self.steps()[:-_KEPT]:
                shutil.rmtree(self._path(step))
            # What a process that was killed had begun to write.
            for part in self.folder.glob("*.part"):
                shutil.rmtree(part)
        # The next chunk, which does not wait for long, begins in all processes at once.
        wait_for_all()

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

    def newest_config(self) -> dict[str, Any] | None:
        """The options that the newest checkpoint was made with, if one says."""
        for step in reversed(self.steps()):
            manifest = read_manifest(self._path(step))
            if manifest is not None and manifest["origin"] is not None:
                config: dict[str, Any] = manifest["origin"]["config"]
                return config
        return None

    def find_newest(self, like: Any) -> int:
        """The vector step of the newest checkpoint, which `load` can read.

        Raises:
          ValueError: there is none, or it is damaged, or of another run, step or configuration;
            names the newest whole one, if there is one.
        """
        steps = self.steps()
        if not steps:
            raise ValueError(f"{self.folder} holds no checkpoint to continue from")
        try:
            self._check(steps[-1], like)
            return steps[-1]
        except ValueError as error:
            for step in reversed(steps[:-1]):
                try:
                    self._check(step, like)
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

    def _check(self, step: int, like: Any) -> None:
        check_tree(self._path(step), like, origin=self._origin, step=step)

    def _path(self, step: int) -> pathlib.Path:
        return self.folder / f"{step:0{_DIGITS}d}"


def _is_key(leaf: Any) -> bool:
    return bool(jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key))


def _to_data(tree: Any) -> dict[str, Any]:
    """The arrays that orbax can write: no empty ones, and PRNG keys as the arrays behind them."""

    def convert(leaf: Any) -> Any:
        if not _is_key(leaf):
            return leaf
        if isinstance(leaf, jax.ShapeDtypeStruct):
            data = jax.eval_shape(jax.random.key_data, leaf)
            return jax.ShapeDtypeStruct(data.shape, data.dtype, sharding=leaf.sharding)
        return jax.random.key_data(leaf)

    leaves = enumerate(jax.tree.leaves(tree))
    return {f"{i:05d}": convert(leaf) for i, leaf in leaves if leaf.size}


def _here(data: dict[str, Any]) -> dict[str, Any]:
    """Shapes and dtypes on the devices that they name, or else on this machine's own.

    The devices that the checkpoint was written from may not be here.
    """
    device = jax.sharding.SingleDeviceSharding(jax.local_devices()[0])
    return {
        name: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=x.sharding or device)
        for name, x in data.items()
    }


def _from_data(data: dict[str, Any], like: Any) -> Any:
    def convert(i: int, wanted: Any) -> Any:
        if not wanted.size:
            return jnp.zeros(wanted.shape, wanted.dtype)
        x = data[f"{i:05d}"]
        return jax.random.wrap_key_data(x) if _is_key(wanted) else x

    leaves, structure = jax.tree.flatten(like)
    tree = jax.tree.unflatten(structure, [convert(i, x) for i, x in enumerate(leaves)])
    return place(tree, like)
