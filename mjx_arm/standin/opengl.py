"""Which OpenGL MuJoCo renders by, without a screen."""

from __future__ import annotations

import contextlib
import ctypes.util
import os
import sys
from collections.abc import Iterator

_LIBRARIES = {"egl": "EGL", "osmesa": "OSMesa"}
NO_OPENGL = "install the system package libegl1 or libosmesa6, or set MUJOCO_GL"


def find_opengl() -> str:
    """The value of MUJOCO_GL for a process without a screen; empty for the system's own.

    Raises:
      ValueError: the system has neither EGL nor OSMesa.
    """
    chosen = os.environ.get("MUJOCO_GL", "")
    if chosen or not sys.platform.startswith("linux"):
        return chosen
    for name, library in _LIBRARIES.items():
        if ctypes.util.find_library(library):
            return name
    raise ValueError(
        f"the stand-in renders by OpenGL, and neither EGL nor OSMesa is here: {NO_OPENGL}"
    )


@contextlib.contextmanager
def opengl_for_children() -> Iterator[None]:
    """Processes that are spawned inside of the `with` block can render.

    MuJoCo chooses its OpenGL when it is imported, so this process may have to stay without.

    Raises:
      ValueError: the system has neither EGL nor OSMesa.
    """
    wanted = {"MUJOCO_GL": find_opengl(), "LP_NUM_THREADS": "1"}
    before = {name: os.environ.get(name) for name in wanted}
    os.environ.update({name: value for name, value in wanted.items() if value})
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
