"""Scenes: MJCF files compiled by MuJoCo. Robots and tasks say what the names in one mean."""

from __future__ import annotations

import base64
import binascii
import dataclasses
import hashlib
import json
import pathlib
from typing import Any

import mujoco
import numpy as np

from mjx_arm.render.geoms import validate_geoms
from mjx_arm.silence import mujoco_silence

_PACKAGE = pathlib.Path(__file__).parent
# An installed package carries its scenes; a checkout has them at the top level.
_XML_DIRS = (_PACKAGE / "xml", _PACKAGE.parent / "xml")


@dataclasses.dataclass(frozen=True)
class SceneSource:
    """What a scene is compiled from, as its files give it.

    Attributes:
      xml: text of the MJCF file.
      files: the files that it includes or takes assets from, by their base names, by which MuJoCo
        finds them in memory.
    """

    xml: str
    files: dict[str, bytes] = dataclasses.field(default_factory=dict)

    @property
    def digest(self) -> str:
        """SHA-256 of the text and of all files."""
        files = {name: hashlib.sha256(data).hexdigest() for name, data in self.files.items()}
        content = json.dumps([self.xml, sorted(files.items())])
        return hashlib.sha256(content.encode("utf-8", "surrogatepass")).hexdigest()

    def to_json(self) -> dict[str, Any]:
        """The source as a JSON object, with its files in base 64."""
        files = {name: base64.b64encode(data).decode() for name, data in self.files.items()}
        return {"xml": self.xml, "files": files, "sha256": self.digest}

    @staticmethod
    def from_json(values: Any, where: str) -> SceneSource:
        """The source from what `to_json` made.

        Raises:
          ValueError: it is something else, or does not match its digest.
        """
        try:
            files = {
                name: base64.b64decode(x, validate=True) for name, x in values["files"].items()
            }
            source = SceneSource(values["xml"], files)
            intact = values["sha256"] == source.digest
        except (TypeError, KeyError, AttributeError, binascii.Error):
            intact = False
        if not intact:
            raise ValueError(f"{where}: the scene in it is damaged")
        return source


@dataclasses.dataclass(frozen=True, eq=False)
class Scene:
    """A compiled model of supported primitives; compared and hashed by identity.

    Attributes:
      name: the scene's name or path, as it was given.
      mj_model: the plain MuJoCo model. Treat it as read-only.
      xml: text of the MJCF file, as it was given.
      files: the files that it refers to; see `SceneSource`.
    """

    name: str
    mj_model: mujoco.MjModel
    xml: str
    files: dict[str, bytes] = dataclasses.field(default_factory=dict)

    @property
    def source(self) -> SceneSource:
        """What the scene was compiled from."""
        return SceneSource(self.xml, self.files)

    def find(self, kind: str, name: str) -> int:
        """Id of a named element.

        Args:
          kind: as MjModel's accessors: `"geom"`, `"site"`, `"joint"`, `"key"`, `"numeric"`, ...
          name: of the element.

        Raises:
          ValueError: the scene has no such element.
        """
        try:
            return int(getattr(self.mj_model, kind)(name).id)
        except KeyError:
            what = "keyframe" if kind == "key" else kind
            raise ValueError(f"scene {self.name!r} has no {what} named {name!r}") from None

    def has(self, kind: str, name: str) -> bool:
        """Whether the scene has an element of this kind and name."""
        try:
            getattr(self.mj_model, kind)(name)
        except KeyError:
            return False
        return True

    def numbers(self, name: str, size: int) -> np.ndarray:
        """The data of a `numeric` element, `[size] float64`.

        Raises:
          ValueError: the scene has no such element, or it has another size, or is not finite.
        """
        index = self.find("numeric", name)
        start, length = self.mj_model.numeric_adr[index], self.mj_model.numeric_size[index]
        data = np.array(self.mj_model.numeric_data[start : start + length])
        if length != size or not np.isfinite(data).all():
            raise ValueError(
                f"scene {self.name!r}: numeric {name!r} must hold {size} finite numbers, "
                f"got {data.tolist()}"
            )
        return data

    @property
    def substeps(self) -> int:
        """Physics substeps in one iteration, the scene's numeric `substeps`.

        Raises:
          ValueError: it is missing, or not a whole number of at least 1.
        """
        return self._counts("substeps", 1)[0]

    @property
    def mjx_iterations(self) -> tuple[int, int]:
        """Most iterations of MJX's solver, and of its line search.

        The scene's numeric `mjx_iterations`, or where it has none, those of its `option`.

        Raises:
          ValueError: they are not whole numbers of at least 1.
        """
        option = self.mj_model.opt
        if not self.has("numeric", "mjx_iterations"):
            return option.iterations, option.ls_iterations
        solver, line_search = self._counts("mjx_iterations", 2)
        return solver, line_search

    def _counts(self, name: str, size: int) -> list[int]:
        values = self.numbers(name, size)
        if (values < 1).any() or (values != np.round(values)).any():
            raise ValueError(
                f"scene {self.name!r}: numeric {name!r} must hold whole numbers of at least 1, "
                f"got {values.tolist()}"
            )
        return [int(value) for value in values]


def available_scenes() -> list[str]:
    """Names of the scenes that come with the package."""
    found = {path.stem for folder in _XML_DIRS for path in folder.glob("*.xml")}
    return sorted(found)


def load_scene(name_or_path: str | pathlib.Path) -> Scene:
    """Compiles a scene that comes with the package, or any MJCF file of supported primitives.

    Args:
      name_or_path: a name such as `"arm_cube"`, or the path of an MJCF file.

    Returns:
      The scene.

    Raises:
      ValueError: no such scene or file, MuJoCo cannot compile it, or a geom in it cannot be
        rendered.
    """
    name = str(name_or_path)
    return compile_scene(name, read_source(name))


def compile_scene(name: str, source: SceneSource) -> Scene:
    """Compiles a scene from memory, so that its source is all that it is made of.

    Raises:
      ValueError: MuJoCo cannot compile it, or a geom in it cannot be rendered.
    """
    try:
        with mujoco_silence:
            mj_model = mujoco.MjModel.from_xml_string(source.xml, source.files)
    except (ValueError, mujoco.FatalError) as error:
        raise _does_not_compile(name, error) from error
    validate_geoms(mj_model)
    return Scene(name, mj_model, source.xml, source.files)


def read_source(name: str) -> SceneSource:
    """Reads the MJCF file of a scene, and every file that it includes or takes assets from.

    Raises:
      ValueError: no such scene or file, or a file that cannot be read, or two with the same name.
    """
    path = _resolve(name).absolute()
    files: dict[str, bytes] = {}
    try:
        # With an absolute path only: MuJoCo 3.17 looks for a nested include in the wrong folder.
        found = {pathlib.Path(other) for other in mujoco.mju_getXMLDependencies(str(path))}
    except (ValueError, mujoco.FatalError) as error:
        raise _does_not_compile(name, error) from error
    for dependency in sorted(found - {path}):
        data = _read(name, dependency)
        if files.setdefault(dependency.name, data) != data:
            raise ValueError(
                f"scene {name!r} takes two files with the name {dependency.name!r}: rename one"
            )
    try:
        return SceneSource(_read(name, path).decode("utf-8"), files)
    except UnicodeDecodeError as error:
        raise ValueError(f"scene {name!r}: {path} is not text in UTF-8") from error


def _does_not_compile(name: str, error: Exception) -> ValueError:
    reason = " ".join(str(error).split())
    return ValueError(f"scene {name!r} does not compile: {reason}")


def _read(name: str, path: pathlib.Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise ValueError(f"scene {name!r}: {path} cannot be read ({error.strerror})") from error


def scene_exists(name_or_path: str) -> bool:
    """Whether there is a scene of this name, or a file at this path."""
    return name_or_path in available_scenes() or pathlib.Path(name_or_path).is_file()


def _resolve(name_or_path: str) -> pathlib.Path:
    for folder in _XML_DIRS:
        if (folder / f"{name_or_path}.xml").is_file():
            return folder / f"{name_or_path}.xml"
    path = pathlib.Path(name_or_path)
    if path.is_file():
        return path
    if path.exists():
        raise ValueError(f"scene {name_or_path!r} must be an MJCF file, got a folder")
    raise ValueError(
        f"unknown scene {name_or_path!r}: give one of {', '.join(available_scenes())}, "
        "or the path of an MJCF file"
    )
