from __future__ import annotations

import atexit
import ctypes.util
import os
import shutil
import sys
import tempfile
from collections.abc import Iterator

# MuJoCo chooses its OpenGL when it is imported, and fails to import where it cannot find it.
if sys.platform.startswith("linux"):
    for library, backend in (("EGL", "egl"), ("OSMesa", "osmesa")):
        if ctypes.util.find_library(library):
            os.environ.setdefault("MUJOCO_GL", backend)
            break

# Most of a test is compiling, so the workers of one test run share what they have compiled. They
# find the folder by this variable. Processes that tests start do not use it: some are killed, or
# cannot write, and would leave half a program there.
_CACHE = "MJX_ARM_TEST_CACHE"
if _CACHE not in os.environ:
    os.environ[_CACHE] = tempfile.mkdtemp(prefix="mjx-arm-tests-")
    atexit.register(shutil.rmtree, os.environ[_CACHE], ignore_errors=True)

import jax  # noqa: E402
import pytest  # noqa: E402

jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_compilation_cache_dir", os.environ[_CACHE])
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)
# A limit in bytes makes jax lock the folder: no worker reads what another one is still writing.
jax.config.update("jax_compilation_cache_max_size", 2**33)


def pytest_configure(config: pytest.Config) -> None:
    """Lets the default tests, and the processes that they start, compile with few optimisations.

    They then take 11 minutes instead of 18 on two cores. Tests with the markers `slow` and `long`
    compile as the product does, but for the programs of several devices or processes.
    """
    if "not slow" not in config.option.markexpr:
        return
    os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"] = "1"
    jax.config.update("jax_disable_most_optimizations", True)
    # With its newer emitters XLA takes twice as long to compile; from jax 0.11 on they cannot be
    # turned off, and XLA aborts at a flag that it does not know.
    if jax.__version_info__ < (0, 11):
        flags = os.environ.get("XLA_FLAGS", "")
        os.environ["XLA_FLAGS"] = f"--xla_cpu_use_fusion_emitters=false {flags}".rstrip()


@pytest.fixture
def optimised() -> Iterator[None]:
    """Compiles a test with XLA's optimisations, for values that must agree to their last bits."""
    before = jax.config.read("jax_disable_most_optimizations")
    jax.config.update("jax_disable_most_optimizations", False)
    yield
    jax.config.update("jax_disable_most_optimizations", before)


@pytest.fixture(scope="session")
def opengl() -> None:
    """Skips where MuJoCo finds no OpenGL, unless MJX_ARM_REQUIRE_GL=1 asks to fail instead."""
    import mujoco

    try:
        mujoco.Renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 8, 8).close()
    except Exception as error:
        reason = (
            f"no OpenGL ({type(error).__name__}: {error}): install the system package libegl1 "
            "or libosmesa6, or set MUJOCO_GL"
        )
        if os.environ.get("MJX_ARM_REQUIRE_GL") == "1":
            pytest.fail(reason)
        pytest.skip(reason)
