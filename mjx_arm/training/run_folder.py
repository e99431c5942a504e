"""The folder of a run: what is in it, who may write to it, and the results of each seed."""

from __future__ import annotations

import contextlib
import dataclasses
import datetime
import json
import os
import pathlib
import uuid
from collections.abc import Iterator
from typing import Any

import filelock
import jax

from mjx_arm.config import TrainConfig, dump_config, parse_config
from mjx_arm.scene import SceneSource
from mjx_arm.training.checkpoint import Origin, RunCheckpoints, config_differences
from mjx_arm.training.objects import Record, parse_record
from mjx_arm.training.seal import is_sealed, seal

CONFIG = "config.json"
EVALUATION = "evaluation.json"
_LOCK = ".lock"
_RUNS = pathlib.Path("runs")


@dataclasses.dataclass(frozen=True)
class SavedRun:
    """What a run's `config.json` says.

    Attributes:
      config: the options.
      objects: record of the user's own objects.
      scene: the files of the scene.
      run_id: of the run, which no other has.
      intact: the file is as the run wrote it.
    """

    config: TrainConfig
    objects: Record
    scene: SceneSource
    run_id: str = dataclasses.field(default_factory=lambda: uuid.uuid4().hex)
    intact: bool = True

    @property
    def origin(self) -> Origin:
        """What the run's checkpoints belong to."""
        return Origin(self.run_id, dump_config(self.config), self.scene.digest)


def save_run(folder: pathlib.Path, run: SavedRun) -> None:
    """Writes `config.json` of a run and of each of its seeds: whole, or the ones before stay."""
    seeds = seed_configs(run.config)
    if len(seeds) > 1:
        for own, config in zip(seed_folders(folder, run.config), seeds, strict=True):
            own.mkdir(exist_ok=True)
            _write(own, dataclasses.replace(run, config=config))
    # Last: a folder that has this can be resumed.
    _write(folder, run)


def _write(folder: pathlib.Path, run: SavedRun) -> None:
    content = dump_config(run.config) | {
        "run_id": run.run_id,
        "objects": run.objects,
        "scene_source": run.scene.to_json(),
    }
    part = folder / f"{CONFIG}.part"
    part.write_text(seal(content), encoding="utf-8")
    part.replace(folder / CONFIG)


def load_run(folder: pathlib.Path) -> SavedRun:
    """Reads `config.json` of a run folder.

    Raises:
      ValueError: the folder holds no configuration of this version.
    """
    path = folder / CONFIG
    if not path.is_file():
        raise ValueError(f"{folder} is not a run folder: it has no {CONFIG}")
    return parse_run(read_text(path), str(path))


def load_config(folder: pathlib.Path) -> TrainConfig:
    """The options of a run folder; see `load_run`."""
    return load_run(folder).config


def parse_run(text: str, where: str) -> SavedRun:
    """What the text of a `config.json` says.

    Raises:
      ValueError: it is not the configuration of a run of this version.
    """
    intact = is_sealed(text)
    objects: Record = {}
    run_id, scene = "", SceneSource("")
    with contextlib.suppress(json.JSONDecodeError, RecursionError):
        values = json.loads(text)
        if isinstance(values, dict):
            values.pop("sha256", None)
            objects = parse_record(values.pop("objects", {}), where)
            run_id = values.pop("run_id", "")
            source = values.pop("scene_source", None)
            scene = SceneSource.from_json(source, where) if intact else scene
            text = json.dumps(values)
    return SavedRun(parse_config(text, where), objects, scene, run_id, intact)


def check_untouched(folder: pathlib.Path, run: SavedRun) -> None:
    """Rejects a run whose `config.json` was edited.

    Raises:
      ValueError: it was; names the options that differ from those of the newest checkpoint.
    """
    if run.intact:
        return
    trained = RunCheckpoints(folder).newest_config()
    changed = config_differences(trained, dump_config(run.config)) if trained else ""
    what = f": {changed}" if changed else ""
    raise ValueError(f"{folder / CONFIG} has changed since the run wrote it{what}; restore it")


def read_text(path: pathlib.Path) -> str:
    """The text of a file.

    Raises:
      ValueError: it cannot be read, or is not UTF-8.
    """
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise ValueError(f"{path} cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ValueError(f"{path} is not text in UTF-8") from error


def seed_folders(folder: pathlib.Path, config: TrainConfig) -> list[pathlib.Path]:
    """Where the results of each seed go."""
    if config.num_seeds == 1:
        return [folder]
    return [folder / f"seed-{config.seed + i}" for i in range(config.num_seeds)]


def seed_configs(config: TrainConfig) -> list[TrainConfig]:
    """The configuration of each seed's own run."""
    return [
        dataclasses.replace(config, seed=config.seed + i, num_seeds=1)
        for i in range(config.num_seeds)
    ]


@contextlib.contextmanager
def locked(folder: pathlib.Path) -> Iterator[None]:
    """Makes this process the only one that writes to a run folder.

    Raises:
      ValueError: another process has the lock.
    """
    lock = filelock.FileLock(folder / _LOCK)
    try:
        lock.acquire(timeout=0)
    except filelock.Timeout:
        raise ValueError(
            f"{folder} is in use by another process: wait until it ends, or give another folder"
        ) from None
    except OSError as error:
        raise ValueError(f"{folder} cannot be written: {error.strerror}") from error
    try:
        yield
    finally:
        lock.release()


def choose_run_folder(name: str) -> pathlib.Path:
    """A free path in `runs`, named by the time, and with a number where that name is taken."""
    stem = f"{datetime.datetime.now():%Y-%m-%d-%H%M%S}-{name}"
    folder, number = _RUNS / stem, 1
    while folder.exists():
        number += 1
        folder = _RUNS / f"{stem}-{number}"
    return folder


def new_run_folder(name: str, folder: pathlib.Path | None = None) -> pathlib.Path:
    """Makes a folder in `runs`; see `choose_run_folder`.

    Args:
      name: the end of the folder's name.
      folder: the path that was chosen. If another process has made it since, another is chosen.

    Raises:
      ValueError: it cannot be made.
    """
    folder = choose_run_folder(name) if folder is None else folder
    try:
        _RUNS.mkdir(exist_ok=True)
        while True:
            # Not `exist_ok`: runs that a cluster starts in one second must not share a folder.
            with contextlib.suppress(FileExistsError):
                folder.mkdir()
                return folder
            folder = choose_run_folder(name)
    except OSError as error:
        raise _cannot_be_made(folder, error) from error


def _cannot_be_made(folder: pathlib.Path, error: OSError) -> ValueError:
    return ValueError(f"{folder} cannot be made ({error.strerror}): give --out another folder")


def check_folder(folder: pathlib.Path) -> None:
    """Checks that a run can be written to a path, and makes nothing.

    Raises:
      ValueError: it is a file, holds something already, or cannot be written.
    """
    try:
        occupied = any(path.name != _LOCK for path in folder.iterdir())
    except FileNotFoundError:
        return
    except NotADirectoryError as error:
        raise ValueError(f"{folder} is a file: give --out a new or empty folder") from error
    except OSError as error:
        raise _cannot_be_made(folder, error) from error
    if not os.access(folder, os.W_OK | os.X_OK):
        raise ValueError(f"{folder} cannot be written: give --out another folder")
    if occupied:
        raise ValueError(f"{folder} is not empty: give --out a new or empty folder")


def prepare_folder(folder: pathlib.Path) -> pathlib.Path:
    """Makes the run folder, and returns it.

    Raises:
      ValueError: see `check_folder`, or it cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError) as error:
        raise ValueError(f"{folder} is a file: give --out a new or empty folder") from error
    except OSError as error:
        raise _cannot_be_made(folder, error) from error
    check_folder(folder)
    return folder


def of_seed(tree: Any, config: TrainConfig, i: int) -> Any:
    """The part of one seed in what a trainer returns for all of them."""
    return tree if config.num_seeds == 1 else jax.tree.map(lambda x: x[i], tree)
