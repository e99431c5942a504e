"""Scenes: MJCF files compiled by MuJoCo. Robots and tasks say what the names in one mean."""

from __future__ import annotations

import contextlib
import dataclasses
import pathlib
import re
from collections.abc import Iterator

import mujoco
import numpy as np

from mjx_arm.render.geoms import validate_geoms

_PACKAGE = pathlib.Path(__file__).parent
# An installed package carries its scenes; a checkout has them at the top level.
_XML_DIRS = (_PACKAGE / "xml", _PACKAGE.parent / "xml")
# By pattern: MuJoCo reads files that are not XML to the letter.
_INCLUDED = re.compile(r"""<(?:include|model)\b[^>]*\bfile=["']([^"']+)["']""")


@dataclasses.dataclass(frozen=True, eq=False)
class Scene:
    """A compiled model of supported primitives; compared and hashed by identity.

    Attributes:
      name: the scene's name or path, as it was given.
      mj_model: the plain MuJoCo model. Treat it as read-only.
      xml: text of the MJCF file, followed by the texts of the files that it includes or attaches.
    """

    name: str
    mj_model: mujoco.MjModel
    xml: str

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
    path = _resolve(str(name_or_path))
    try:
        with _quiet():
            mj_model = mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        reason = " ".join(str(error).split())
        raise ValueError(f"scene {str(name_or_path)!r} does not compile: {reason}") from error
    validate_geoms(mj_model)
    return Scene(name=str(name_or_path), mj_model=mj_model, xml=_read(path))


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Keeps MuJoCo from printing warnings and from writing MUJOCO_LOG.TXT.

    It warns of a body that is attached without a prefix, because such a model may not be saved
    correctly. It is never saved here.
    """
    before, quiet = mujoco.MjLogConfig.get(), mujoco.MjLogConfig.get()
    quiet.logto_console = quiet.logto_file = False
    mujoco.MjLogConfig.set(quiet)
    try:
        yield
    finally:
        mujoco.MjLogConfig.set(before)


def _read(path: pathlib.Path) -> str:
    """Text of an MJCF file, followed by the texts of the files that it includes or attaches."""
    text = path.read_text(encoding="utf-8")
    files = [path.parent / name for name in _INCLUDED.findall(text)]
    return "".join([text, *(_read(file) for file in files if file.is_file())])


def _resolve(name_or_path: str) -> pathlib.Path:
    for folder in _XML_DIRS:
        if (folder / f"{name_or_path}.xml").is_file():
            return folder / f"{name_or_path}.xml"
    path = pathlib.Path(name_or_path)
    if path.is_file():
        return path
    raise ValueError(
        f"unknown scene {name_or_path!r}: give one of {', '.join(available_scenes())}, "
        "or the path of an MJCF file"
    )
