"""CoLa framing: where a telegram starts and ends in a stream of bytes. No I/O, no clock.

In: bytes as a socket gives them, cut anywhere, with anything between telegrams. Out: whole payloads. The law: what is
no telegram is skipped and counted, nothing else is lost, and never more than one telegram is kept.

    CoLa A (text)      02 payload 03
    CoLa B (binary)    02 02 02 02, payload length (u32, big endian), payload, XOR of the payload's bytes

A binary payload may itself contain 02 02 02 02, so a head is looked for only where a telegram may begin, and after a
wrong length or checksum the search goes on one byte behind the head that was wrong.

Source: SICK Telegram Listing 8014631, §2; captured sessions of an LMS111.
"""

import re
from enum import Enum

import numpy as np

from hw_profiles.errors import RTLogError

MAX_PAYLOAD_BYTES = 65536  # the longest of an LMS111, 1,081 points with remission in CoLa A, has about 10,000

STX, ETX = b"\x02", b"\x03"
BINARY_HEAD = 4 * STX
BINARY_HEAD_BYTES = 8  # with the length
PAYLOAD_START = ord("s")  # of every payload: sRN, sAN, sFA …

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
        self._next_payload = self._next_text if dialect is Dialect.A else self._next_binary
        self._buffer = bytearray()

    def feed(self, data: bytes) -> list[bytes]:
        """The payloads that these bytes complete, oldest first."""
        self._buffer += data
        payloads = []
        while (payload := self._next_payload()) is not None:
            payloads.append(payload)
        return payloads

    def _skip(self, count: int) -> None:
        self.skipped_bytes += count
        del self._buffer[:count]

    def _next_text(self) -> bytes | None:
        """The next payload of CoLa A, None if more bytes are needed. A second 02 before the 03 starts anew."""
        while (end := self._buffer.find(ETX)) >= 0:
            start = self._buffer.rfind(STX, 0, end)
            if start < 0:
                self._skip(end + 1)
                continue
            payload = bytes(self._buffer[start + 1 : end])
            self._skip(start)
            del self._buffer[: end - start + 1]
            return payload
        start = self._buffer.rfind(STX)
        cut = start >= 0 and len(self._buffer) - start <= MAX_PAYLOAD_BYTES
        self._skip(start if cut else len(self._buffer))
        return None

    def _next_binary(self) -> bytes | None:
        """The next payload of CoLa B, None if more bytes are needed."""
        while (start := self._buffer.find(BINARY_HEAD)) >= 0:
            self._skip(start)
            if len(self._buffer) <= BINARY_HEAD_BYTES:
                return None
            length = int.from_bytes(self._buffer[4:BINARY_HEAD_BYTES])
            end = BINARY_HEAD_BYTES + length
            plausible = 0 < length <= MAX_PAYLOAD_BYTES and self._buffer[BINARY_HEAD_BYTES] == PAYLOAD_START
            if plausible and len(self._buffer) <= end:
                return None
            if plausible:
                payload = bytes(self._buffer[BINARY_HEAD_BYTES:end])
                if xor(payload) == self._buffer[end]:
                    del self._buffer[: end + 1]
                    return payload
            self._skip(1)
        self._skip(max(0, len(self._buffer) - len(BINARY_HEAD) + 1))  # what is left may be the start of a head
        return None
