"""Calls of Python from a program that is compiled for the CPU, by a name instead of an address.

jax keeps no program on disk that holds one of its own callbacks, whose address the next process
does not have. XLA's foreign functions are looked up by name, and ctypes can make one: below is the
part of its C interface (xla/ffi/api/c_api.h, version 0.3) that is read.
"""

from __future__ import annotations

import ctypes
import traceback
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import jax
import numpy as np

HostFunction = Callable[[np.ndarray, np.ndarray], None]

_METADATA = 1
_INTERNAL = 13


class _Headed(ctypes.Structure):
    """What nearly all of them begin with."""

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


def register(name: str, function: HostFunction) -> None:
    """Lets compiled programs call a function by name; the last of a name counts.

    Args:
      name: of the function; the same in every process that is to share compiled programs.
      function: `function(operand, result)`, reads the one and fills the other, `[..., K]` and
        `[..., L]` uint32 in XLA's own memory. Called from several threads at once.
    """
    _functions[name] = function
    if name in _handlers:
        return

    def handle(pointer: Any) -> int | None:
        frame = pointer.contents
        try:
            if frame.extension and frame.extension.contents.type == _METADATA:
                _describe(frame)
            else:
                _functions[name](_array(frame.arguments), _array(frame.results))
        except BaseException:
            return _error(frame, traceback.format_exc())
        return None

    _handlers[name] = handler = _Handler(handle)
    capsule = jax.ffi.pycapsule(ctypes.cast(handler, ctypes.c_void_p))
    jax.ffi.register_ffi_target(name, capsule, platform="cpu", api_version=1)


def call(name: str, operand: jax.Array, result: jax.ShapeDtypeStruct) -> jax.Array:
    """Calls a registered function; under vmap once with all rows.

    Args:
      name: of the function.
      operand: `[...] uint32`, what it reads.
      result: shape of what it fills, uint32.

    Returns:
      What it filled. What it raises comes out of the program as an error of XLA.
    """
    done: jax.Array = jax.ffi.ffi_call(name, result, vmap_method="broadcast_all")(operand)
    return done


def _describe(frame: _Frame) -> None:
    """Answers which version this is made for: this major one, of which minor ones only add."""
    extension = ctypes.cast(frame.extension, ctypes.POINTER(_MetadataExtension)).contents
    metadata = extension.metadata.contents
    metadata.version.major = 0
    metadata.version.minor = frame.api.contents.version.minor
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
