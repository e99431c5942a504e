"""Messages over a socket: a JSON object, and bytes with it.

A message is 12 bytes (`MJXA`, and the two lengths as big-endian uint32), the object as UTF-8, and
the bytes.
"""

from __future__ import annotations

import json
import socket
import struct
from collections.abc import Mapping
from typing import Any

LOOPBACK = "127.0.0.1"
_MAGIC = b"MJXA"
_HEADER = struct.Struct("!4sII")
# No message of ours is longer.
_MOST_TEXT, _MOST_BYTES = 1 << 16, 1 << 26


class GarbageError(ValueError):
    """What came over the socket is no message."""


class ClosedError(Exception):
    """The other side has closed the socket, or is gone."""


def send(sock: socket.socket, values: Mapping[str, Any], data: bytes = b"") -> None:
    """Sends a message, in one call.

    Raises:
      ClosedError: the other side is gone.
    """
    text = json.dumps(values).encode()
    try:
        sock.sendall(_HEADER.pack(_MAGIC, len(text), len(data)) + text + data)
    except OSError as error:
        raise ClosedError(error.strerror or str(error)) from error


def receive(sock: socket.socket) -> tuple[dict[str, Any], bytes]:
    """Waits for a message.

    Raises:
      GarbageError: it is none.
      ClosedError: the other side is gone.
    """
    magic, text_size, size = _HEADER.unpack(_read(sock, _HEADER.size))
    if magic != _MAGIC or text_size > _MOST_TEXT or size > _MOST_BYTES:
        raise GarbageError("garbage came over the socket")
    text, data = _read(sock, text_size), _read(sock, size)
    try:
        values = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise GarbageError("garbage came over the socket") from error
    if not isinstance(values, dict) or not isinstance(values.get("kind"), str):
        raise GarbageError("a message without a kind came over the socket")
    return values, data


def _read(sock: socket.socket, size: int) -> bytes:
    parts = bytearray()
    while len(parts) < size:
        try:
            part = sock.recv(min(size - len(parts), 1 << 16))
        except OSError as error:
            raise ClosedError(error.strerror or str(error)) from error
        if not part:
            raise ClosedError("the other side has closed the socket")
        parts += part
    return bytes(parts)
