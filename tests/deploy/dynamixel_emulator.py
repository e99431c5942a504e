"""Servos of the X series behind a pseudo-terminal, by protocol 2.0 (ROBOTIS e-Manual), and faults.

Written from the description of the protocol, with a checksum of its own, so that it shares no code
with dynamixel-sdk.
"""

from __future__ import annotations

import os
import pty
import select
import threading
import tty

PING, READ, WRITE, SYNC_READ, STATUS = 0x01, 0x02, 0x03, 0x82, 0x55
BROADCAST = 0xFE
_HEAD = b"\xff\xff\xfd\x00"


def checksum(data: bytes) -> int:
    """CRC-16 with the polynomial x16 + x15 + x2 + 1, bit by bit."""
    crc = 0
    for byte in data:
        crc ^= byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ (0x8005 if crc & 0x8000 else 0)) & 0xFFFF
    return crc


class Servo:
    """One servo's control table. A goal is reached at once, unless it is stuck."""

    def __init__(self, mode: int = 3, position: int = 2048) -> None:
        self.table = bytearray(150)
        self.table[11] = mode
        self.set(132, 4, position)
        self.stuck = False
        self.writes: list[tuple[int, int]] = []

    def get(self, address: int, size: int) -> int:
        return int.from_bytes(self.table[address : address + size], "little", signed=size == 4)

    def set(self, address: int, size: int, value: int) -> None:
        self.table[address : address + size] = value.to_bytes(size, "little", signed=size == 4)

    def write(self, address: int, data: bytes) -> None:
        self.table[address : address + len(data)] = data
        self.writes.append((address, int.from_bytes(data, "little", signed=len(data) == 4)))
        if address == 116 and not self.stuck:
            self.set(132, 4, self.get(116, 4))


class Bus:
    """Servos on a pseudo-terminal; use it in a `with` block.

    Attributes:
      port: path of the terminal.
      servos: by their ids.
      silent: ids that do not answer.
      damaged: how many of the next answers have a wrong checksum.
      late: seconds that an answer waits.
    """

    def __init__(self, servos: dict[int, Servo]) -> None:
        self.servos, self.silent = servos, set[int]()
        self.damaged, self.late = 0, 0.0
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        self.port = os.ttyname(self._slave)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> Bus:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self.pull()

    def pull(self) -> None:
        """The cable is pulled."""
        if not self._ended.is_set():
            self._ended.set()
            self._thread.join()
            os.close(self._master)
            os.close(self._slave)

    def _run(self) -> None:
        received = b""
        while not self._ended.is_set():
            if not select.select([self._master], [], [], 0.01)[0]:
                continue
            received += os.read(self._master, 4096)
            while packet := self._next(received):
                received = received[received.index(_HEAD) + 7 + len(packet) :]
                self._answer(packet)

    def _next(self, received: bytes) -> bytes | None:
        """The first whole packet from its instruction on, checksum included."""
        at = received.find(_HEAD)
        if at < 0 or len(received) < at + 7:
            return None
        length = int.from_bytes(received[at + 5 : at + 7], "little")
        if len(received) < at + 7 + length:
            return None
        whole = received[at : at + 7 + length]
        assert checksum(whole[:-2]) == int.from_bytes(whole[-2:], "little")
        self._id = whole[4]
        return whole[7:]

    def _answer(self, packet: bytes) -> None:
        instruction, parameters = (
            packet[0],
            packet[1:-2].replace(b"\xff\xff\xfd\xfd", b"\xff\xff\xfd"),
        )
        if instruction == SYNC_READ:
            address, size = (int.from_bytes(parameters[i : i + 2], "little") for i in (0, 2))
            for servo in parameters[4:]:
                self._send(servo, self.servos[servo].table[address : address + size])
            return
        if self._id not in self.servos:
            return
        servo = self.servos[self._id]
        if instruction == PING:
            self._send(self._id, b"\x06\x04\x2d")
        elif instruction == READ:
            address, size = (int.from_bytes(parameters[i : i + 2], "little") for i in (0, 2))
            self._send(self._id, servo.table[address : address + size])
        elif instruction == WRITE and self._id not in self.silent:
            servo.write(int.from_bytes(parameters[:2], "little"), parameters[2:])
            self._send(self._id, b"")

    def _send(self, servo: int, parameters: bytes) -> None:
        if servo in self.silent:
            return
        alert = 0x80 if self.servos[servo].table[70] else 0
        body = bytes([STATUS, alert]) + bytes(parameters).replace(
            b"\xff\xff\xfd", b"\xff\xff\xfd\xfd"
        )
        packet = _HEAD + bytes([servo]) + (len(body) + 2).to_bytes(2, "little") + body
        crc = checksum(packet)
        if self.damaged:
            self.damaged, crc = self.damaged - 1, crc ^ 0x0101
        if self.late:
            self._ended.wait(self.late)
        os.write(self._master, packet + crc.to_bytes(2, "little"))
