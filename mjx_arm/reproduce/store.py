"""The files of the page's folder: one JSON file for each cell, and its pictures."""

from __future__ import annotations

import dataclasses
import json
import pathlib
from collections.abc import Mapping
from typing import Any

FORMAT = 1
CELLS, PICTURES, RUNS = "cells", "pictures", "runs"


@dataclasses.dataclass(frozen=True)
class Measured:
    """What the file of a cell holds.

    Attributes:
      name: of the cell.
      command: that wrote it.
      inputs: what was measured, and how; with another agent or other options the file is void.
      result: the figures.
      pictures: file names in `pictures/`.
      machine: that it was measured on.
      seconds: that it took.
      date: when it was written.
    """

    name: str
    command: str
    inputs: dict[str, Any]
    result: dict[str, Any]
    pictures: tuple[str, ...]
    machine: dict[str, Any]
    seconds: float
    date: str

    @property
    def file(self) -> str:
        """Its file, relative to the page's folder."""
        return f"{CELLS}/{self.name}.json"


@dataclasses.dataclass(frozen=True)
class Store:
    """The folder of a page."""

    folder: pathlib.Path

    def prepare(self) -> None:
        """Makes the folders.

        Raises:
          ValueError: they cannot be made.
        """
        for path in (self.folder, self.folder / CELLS, self.folder / PICTURES):
            try:
                path.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise ValueError(
                    f"{path} cannot be made ({error.strerror}): give --out another folder"
                ) from error

    def read(self, name: str) -> Measured | None:
        """A cell's file; None if there is none, or if a picture of it is missing.

        Raises:
          ValueError: the file is damaged.
        """
        values = self.read_report(name)
        if values is None:
            return None
        try:
            if values.pop("format") != FORMAT:
                return None
            found = Measured(**{**values, "pictures": tuple(values["pictures"])})
        except (KeyError, TypeError):
            raise self.damaged(name) from None
        complete = all((self.folder / PICTURES / each).is_file() for each in found.pictures)
        return found if complete else None

    def read_report(self, name: str) -> dict[str, Any] | None:
        """The JSON object that a benchmark has left among the cells; None if there is none.

        Raises:
          ValueError: the file is damaged.
        """
        path = self.folder / CELLS / f"{name}.json"
        if not path.is_file():
            return None
        try:
            values = json.loads(path.read_text(encoding="utf-8"))
        except ValueError:
            values = None
        if not isinstance(values, dict):
            raise self.damaged(name)
        return values

    def damaged(self, name: str) -> ValueError:
        """The error of a file among the cells that cannot be read."""
        path = self.folder / CELLS / f"{name}.json"
        return ValueError(f"{path} is damaged: remove it, and measure it again")

    def write(self, measured: Measured, pictures: Mapping[str, bytes]) -> None:
        """Writes a cell: its pictures first, so that where its file is they are there too.

        Raises:
          ValueError: a figure is infinite or NaN.
          OSError: the disk does not take the files.
        """
        for name, content in pictures.items():
            _write(self.folder / PICTURES / name, content)
        values = {"format": FORMAT, **dataclasses.asdict(measured)}
        # A line for each entry: thousands of lines of numbers help nobody.
        lines = [f"{json.dumps(k)}: {json.dumps(v, allow_nan=False)}" for k, v in values.items()]
        text = "{\n" + ",\n".join(lines) + "\n}\n"
        _write(self.folder / CELLS / f"{measured.name}.json", text.encode())

    def picture(self, name: str) -> bytes:
        """The content of a picture."""
        return (self.folder / PICTURES / name).read_bytes()


def _write(path: pathlib.Path, content: bytes) -> None:
    part = path.with_name(f"{path.name}.part")
    try:
        part.write_bytes(content)
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)
