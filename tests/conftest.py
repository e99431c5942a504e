from __future__ import annotations

import atexit
import ctypes.util
import os
import shutil
import sys
import tempfile

# MuJoCo chooses its OpenGL when it is imported, and fails to import where it cannot find it.
if sys.platform.startswith("linux"):
    for library, backend in (("EGL", "egl"), ("OSMesa", "osmesa")):
        if ctypes.util.find_library(library):
            os.environ.setdefault("MUJOCO_GL", backend)
            break

# Most of a test is compiling. The processes of one test run share what they have compiled; the
# limit in bytes makes jax lock the folder, so that none reads what another is still writing.
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    _cache = tempfile.mkdtemp(prefix="mjx-arm-tests-")
    atexit.register(shutil.rmtree, _cache, ignore_errors=True)
    os.environ["JAX_COMPILATION_CACHE_DIR"] = _cache
    os.environ["JAX_COMPILATION_CACHE_MAX_SIZE"] = str(2**33)
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.2"

import jax

jax.config.update("jax_numpy_dtype_promotion", "strict")
