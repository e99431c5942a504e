"""Calls of Python from a program that is compiled for the CPU, by a name instead of an address.

jax cannot store a program on disk that holds one of its own callbacks, because the next process has
the callback at another address. XLA looks up foreign functions by name, and ctypes can make one.
Below is the part of XLA's C interface (xla/ffi/api/c_api.h, version 0.3) that this needs.

XLA reports the size of each of its structs. `usable` compares those sizes with the ones below, in a
small program that runs once in a process. Where they differ, `call` uses jax's own callback.
"""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import functools
import math
import time
import traceback
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental.buffer_callback import buffer_callback

HostFunction = Callable[[np.ndarray, np.ndarray], None]

_METADATA = 1
_INTERNAL = 13
_PROBE = "mjx_arm_probe"


class _Headed(ctypes.Structure):
    """The first fields of nearly every struct."""

    _fields_: ClassVar[Sequence[tuple[str, Any]]] = (
        ("size", ctypes.c_size_t),
        ("extension", ctypes.c_void_p),
    )


class _Extension(ctypes.Structure):
    _fields_ = (("size", ctypes.c_size_t), ("type", ctypes.c_int), ("next", ctypes.c_void_p))


class _Version(_Headed):
    _fields_ = (
        ("major", ctypes.c_int),
        ("minor", ctypes.c_int),
    )


class _Metadata(ctypes.Structure):
    _fields_ = (("size", ctypes.c_size_t), ("version", _Version), ("traits", ctypes.c_uint32))


class _MetadataExtension(ctypes.Structure):
    _fields_ = (("base", _Extension), ("metadata", ctypes.POINTER(_Metadata)))


class _Buffer(_Headed):
    _fields_ = (
        ("dtype", ctypes.c_int),
        ("data", ctypes.c_void_p),
        ("rank", ctypes.c_int64),
        ("dims", ctypes.POINTER(ctypes.c_int64)),
    )


class _Buffers(_Headed):
    _fields_ = (
        ("count", ctypes.c_int64),
        ("types", ctypes.c_void_p),
        ("buffers", ctypes.POINTER(ctypes.POINTER(_Buffer))),
    )


class _ErrorArguments(_Headed):
    _fields_ = (
        ("message", ctypes.c_char_p),
        ("code", ctypes.c_int),
    )


_MakeError = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.POINTER(_ErrorArguments))


class _Api(_Headed):
    _fields_ = (
        ("version", _Version),
        ("internal", ctypes.c_void_p),
        ("make_error", _MakeError),
    )


class _Frame(ctypes.Structure):
    _fields_ = (
        ("size", ctypes.c_size_t),
        ("extension", ctypes.POINTER(_Extension)),
        ("api", ctypes.POINTER(_Api)),
        ("context", ctypes.c_void_p),
        ("stage", ctypes.c_int),
        ("arguments", _Buffers),
        ("results", _Buffers),
    )


_Handler = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.POINTER(_Frame))
# XLA holds their addresses for as long as the process lives.
_handlers: dict[str, Any] = {}
_functions: dict[str, HostFunction] = {}
# When each last returned, seconds of the monotonic clock.
_last_call: dict[str, float] = {}
# A program that still runs when Python ends is taken to make a call within the first time, and its
# next call within the second, both in seconds.
_FIRST, _NEXT = 0.5, 2.0


def register(name: str, function: HostFunction) -> None:
    """Lets compiled programs call a function by name. A later function replaces an earlier one.

    Args:
      name: name of the function, the same in every process that shares compiled programs.
      function: `function(operand, result)` reads the operand `[..., K]` and fills the result
        `[..., L]`, uint32 arrays in XLA's own memory. Several threads may call it at once.
    """
    _functions[name] = function
    if usable():
        _register(name)


def _register(name: str) -> None:
    if name in _handlers:
        return

    def handle(pointer: Any) -> int | None:
        frame = pointer.contents
        try:
            if frame.size < ctypes.sizeof(_Frame):
                return None
            if frame.extension and frame.extension.contents.type == _METADATA:
                _describe(frame)
            elif name != _PROBE or _same_layout(frame):
                _run(name, _functions[name], _array(frame.arguments), _array(frame.results))
        except BaseException:
            return _error(frame, traceback.format_exc())
        return None

    handler = _Handler(handle)
    capsule = jax.ffi.pycapsule(ctypes.cast(handler, ctypes.c_void_p))
    # Kept even if the registration fails, since XLA may hold the address by then.
    _handlers[name] = handler
    jax.ffi.register_ffi_target(name, capsule, platform="cpu", api_version=1)


def call(
    name: str, function: HostFunction, operand: jax.Array, result: jax.ShapeDtypeStruct
) -> jax.Array:
    """Calls a registered function; under vmap once with all rows.

    On CPU the function works on XLA's own buffers and is called by its name, or by
    `buffer_callback` where that is not possible. On another device `pure_callback` copies the rows
    to the host. On CPU `pure_callback` takes 65 us, since it puts its operands on a device again
    from inside the running program, and every process compiles a program that holds one anew.

    Args:
      name: name of the function.
      function: the function that was registered under the name.
      operand: `[...] uint32`, what it reads.
      result: shape of what it fills, uint32.

    Returns:
      What it filled. An exception in the function becomes an error of XLA.
    """

    def copied(operand: np.ndarray) -> np.ndarray:
        out = np.empty((*np.shape(operand)[:-1], *result.shape), result.dtype)
        function(np.asarray(operand), out)
        return out

    returned: jax.Array = jax.lax.platform_dependent(
        operand,
        cpu=lambda operand: _call_on_cpu(name, function, operand, result),
        default=lambda operand: jax.pure_callback(
            copied, result, operand, vmap_method="broadcast_all"
        ),
    )
    # A callback forgets over which axes of a mesh its operands vary, which `shard_map` checks.
    return returned | (operand[0] & jnp.uint32(0))


def _call_on_cpu(
    name: str, function: HostFunction, operand: jax.Array, result: jax.ShapeDtypeStruct
) -> jax.Array:
    if usable():
        # The handler must exist, also where the verdict came after `register`.
        _register(name)
        return jax.ffi.ffi_call(name, result, vmap_method="broadcast_all")(operand)

    def in_place(context: Any, out: Any, rows: Any) -> None:
        del context
        _run(name, function, np.asarray(rows), np.asarray(out))

    return buffer_callback(in_place, result, vmap_method="broadcast_all")(operand)


def _run(name: str, function: HostFunction, operand: np.ndarray, result: np.ndarray) -> None:
    try:
        function(operand, result)
    finally:
        _last_call[name] = time.monotonic()


@functools.cache
def usable() -> bool:
    """Whether this XLA's structs are those below: a small program calls a function that checks."""
    try:
        device = jax.local_devices(backend="cpu")[0]
    except RuntimeError:
        return False
    # Registered after jax has made its device, so that it runs before jax lets go of that.
    atexit.register(_wait_for_calls)
    _functions[_PROBE] = lambda operand, result: np.copyto(result, operand + np.uint32(1))
    try:
        _register(_PROBE)
        with jax.ensure_compile_time_eval(), jax.disable_jit(False), jax.default_device(device):
            operand = np.arange(3, dtype=np.uint32)
            result = jax.ShapeDtypeStruct((3,), np.uint32)
            probe = jax.jit(lambda rows: jax.ffi.ffi_call(_PROBE, result)(rows))
            return bool((np.asarray(probe(operand)) == operand + 1).all())
    except Exception:
        return False


def _wait_for_calls() -> None:
    """Waits until no program runs that calls Python, which would crash or hang once Python ends.

    A program whose results nobody holds any more is known by its calls alone.
    """
    for array in jax.live_arrays():
        with contextlib.suppress(Exception):  # it was donated, or its program failed
            array.block_until_ready()
    begun = time.monotonic()
    quiet_from = begun + _FIRST
    while time.monotonic() < quiet_from:
        time.sleep(0.02)
        last = max(_last_call.values(), default=-math.inf)
        if last > begun:
            quiet_from = last + _NEXT


def _same_layout(frame: _Frame) -> bool:
    """Whether the structs of a call have the sizes of those above.

    XLA writes its own size into the first field of each. The frame may be longer: what follows the
    results is not read.
    """
    for buffers in (frame.arguments, frame.results):
        if buffers.size != ctypes.sizeof(_Buffers) or buffers.count != 1:
            return False
        if buffers.buffers[0].contents.size != ctypes.sizeof(_Buffer):
            return False
    return True


def _describe(frame: _Frame) -> None:
    """Tells XLA which version this is made for; XLA rejects the missing answer to a new layout.

    Minor versions only add to a major one, so the answer has XLA's own minor version.
    """
    extension = ctypes.cast(frame.extension, ctypes.POINTER(_MetadataExtension)).contents
    api = frame.api.contents
    if (
        extension.base.size < ctypes.sizeof(_MetadataExtension)
        or extension.metadata.contents.size < _Metadata.traits.offset
        or api.size < _Api.make_error.offset
        or api.version.size != ctypes.sizeof(_Version)
        or api.version.major != 0
    ):
        return
    metadata = extension.metadata.contents
    metadata.version.major = 0
    metadata.version.minor = api.version.minor
    metadata.traits = 0


def _array(buffers: _Buffers) -> np.ndarray:
    """The first of the buffers where it lies: `[...] uint32`."""
    buffer = buffers.buffers[0].contents
    shape = tuple(buffer.dims[: buffer.rank])
    size = int(np.prod(shape, dtype=np.int64))
    if size == 0:
        return np.empty(shape, np.uint32)
    memory = (ctypes.c_uint32 * size).from_address(buffer.data)
    return np.ctypeslib.as_array(memory).reshape(shape)


def _error(frame: _Frame, message: str) -> int | None:
    arguments = _ErrorArguments(message=message.encode(), code=_INTERNAL)
    arguments.size = ctypes.sizeof(arguments)
    error: int | None = frame.api.contents.make_error(ctypes.byref(arguments))
    return error
