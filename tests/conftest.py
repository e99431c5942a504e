from __future__ import annotations

import ctypes.util
import os
import sys

# MuJoCo chooses its OpenGL when it is imported, and fails to import where it cannot find it.
if sys.platform.startswith("linux"):
    for library, backend in (("EGL", "egl"), ("OSMesa", "osmesa")):
        if ctypes.util.find_library(library):
            os.environ.setdefault("MUJOCO_GL", backend)
            break

import jax

jax.config.update("jax_numpy_dtype_promotion", "strict")
