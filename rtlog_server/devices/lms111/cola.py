"""CoLa framing: where a telegram starts and ends in a stream of bytes. No I/O, no clock.

In: bytes as a socket gives them, cut anywhere, with anything between telegrams. Out: whole payloads. The law: what is
no telegram is skipped and counted, nothing else is lost, and never more than one telegram is kept.

    CoLa A (text)      02 payload 03
    CoLa B (binary)    02 02 02 02, payload length (u32, big endian), payload, XOR of the payload's bytes

A binary payload may itself contain 02 02 02 02, so a head is looked for only where a telegram may begin, and after a
wrong checksum the search goes on one byte behind the head that was wrong.

Source: SICK Telegram Listing 8014631, §2; captured sessions of an LMS111.
"""

import re
from collections.abc import Iterator
from enum import Enum

import numpy as np

from hw_profiles.errors import RTLogError

MAX_PAYLOAD_BYTES = 32767  # the longest of an LMS111, two echoes of 1,081 points in CoLa A, has about 22,000

STX, ETX = b"\x02", b"\x03"
BINARY_HEAD = 4 * STX
BINARY_HEAD_BYTES = 8  # with the length

TEXT_TELEGRAM = re.compile(rb"\x02(s[^\x02\x03]{2,%d})\x03" % (MAX_PAYLOAD_BYTES - 1))
BINARY_START = re.compile(rb"\x02{4}\0\0[\0-\x7f][\0-\xff]s")  # a possible length, and every payload begins with s
COMMAND = re.compile(rb"(s[A-Z]{2}) (\w+)(?: |\Z)", re.ASCII)


class ColaError(RTLogError):
    """A telegram that is not what it should be: too short, no number where one belongs, no command."""


class Dialect(Enum):
    A = "CoLa A"
    B = "CoLa B"

    @property
    def other(self) -> "Dialect":
        return Dialect.A if self is Dialect.B else Dialect.B


def xor(payload: bytes) -> int:
    return int(np.bitwise_xor.reduce(np.frombuffer(payload, np.uint8)))


def frame(dialect: Dialect, payload: bytes) -> bytes:
    """A payload as it goes on the wire."""
    if dialect is Dialect.A:
        return STX + payload + ETX
    return BINARY_HEAD + len(payload).to_bytes(4) + payload + bytes([xor(payload)])


def split_command(payload: bytes) -> tuple[str, bytes]:
    """`sRA LMPscancfg` and the arguments behind it. An error, `sFA`, is a command without a name.

    Raises:
        ColaError: the payload does not begin with a command.
    """
    if payload.startswith(b"sFA"):
        return "sFA", payload[3:].removeprefix(b" ")
    match = COMMAND.match(payload)
    if match is None:
        raise ColaError(f"telegram of {len(payload)} bytes begins with no command: {payload[:20]!r}")
    return f"{match[1].decode()} {match[2].decode()}", payload[match.end() :]


class Receiver:
    """Cuts a stream of bytes into payloads."""

    def __init__(self, dialect: Dialect) -> None:
        self.skipped_bytes = 0  # garbage and broken telegrams so far
        self._cut = self._cut_text if dialect is Dialect.A else self._cut_binary
        self._buffer = bytearray()

    def feed(self, data: bytes) -> list[bytes]:
        """The payloads that these bytes complete, oldest first."""
        self._buffer += data
        return list(self._cut())

    def _skip(self, count: int) -> None:
        self.skipped_bytes += count
        del self._buffer[:count]

    def _cut_text(self) -> Iterator[bytes]:
        """Whole payloads of CoLa A. A second 02 before the 03 starts anew."""
        while match := TEXT_TELEGRAM.search(self._buffer):
            start, end, payload = match.start(), match.end(), match[1]
            self._skip(start)
            del self._buffer[: end - start]
            yield payload
        start = max(self._buffer.rfind(STX), self._buffer.rfind(ETX))
        begun = start >= 0 and self._buffer[start : start + 1] == STX and len(self._buffer) - start <= MAX_PAYLOAD_BYTES
        self._skip(start if begun else len(self._buffer))

    def _cut_binary(self) -> Iterator[bytes]:
        """Whole payloads of CoLa B."""
        while match := BINARY_START.search(self._buffer):
            start = match.start()
            self._skip(start)
            end = BINARY_HEAD_BYTES + int.from_bytes(self._buffer[4:BINARY_HEAD_BYTES])
            if len(self._buffer) <= end:
                return
            payload = bytes(self._buffer[BINARY_HEAD_BYTES:end])
            if payload and xor(payload) == self._buffer[end]:
                del self._buffer[: end + 1]
                yield payload
            else:
                self._skip(1)
        self._skip(max(0, len(self._buffer) - BINARY_HEAD_BYTES))  # what is left may be the start of one
