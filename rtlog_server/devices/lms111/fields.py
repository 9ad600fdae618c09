"""The values inside a CoLa telegram, in both dialects, by the letters of Python's `struct`.

    B u8   H u16   I u32   h i16   i i32   f REAL

In: a payload, or values. Out: values, or a payload. A reader trusts nothing: whatever does not fit is a `ColaError`.

    CoLa B    big endian, packed
    CoLa A    fields with a blank between; hexadecimal without leading zeros, signed ones as two's complement of their
              width, REAL as the eight digits of its IEEE 754 image; requests may hold decimals with an explicit sign
    texts     a u16 length, then the characters, which may be blanks; in CoLa A nothing follows length 0

Source: SICK Telegram Listing 8014631, §2.3; captured telegrams.
"""

import re
import struct
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtlog_server.devices.lms111.cola import ETX, STX, ColaError, Dialect

DTYPES: dict[str, Any] = {"B": np.uint8, "H": np.uint16}
NUMBER = re.compile(rb"[0-9A-Fa-f]{1,16}\Z|[+-][0-9]{1,16}\Z")
ENCODING = "latin-1"  # every byte is a character and back

Array = NDArray[np.uint8] | NDArray[np.uint16]


class BinaryReader:
    def __init__(self, data: bytes) -> None:
        self._data = data
        self._at = 0

    def take(self, layout: str) -> tuple[Any, ...]:
        """The next values; REALs come as floats."""
        try:
            values = struct.unpack_from(f">{layout}", self._data, self._at)
        except struct.error as error:
            raise _too_short(self._data, self._at) from error
        self._at += struct.calcsize(f">{layout}")
        return values

    def characters(self, count: int) -> str:
        """A text of fixed length."""
        text = self._data[self._at : self._at + count]
        if len(text) < count:
            raise _too_short(self._data, self._at)
        self._at += count
        return text.decode(ENCODING)

    def text(self) -> str:
        return self.characters(self.take("H")[0])

    def array(self, code: str, count: int) -> Array:
        """(count,) values of one type."""
        dtype = np.dtype(DTYPES[code]).newbyteorder(">")
        if len(self._data) - self._at < count * dtype.itemsize:
            raise _too_short(self._data, self._at)
        values = np.frombuffer(self._data, dtype, count, self._at).astype(DTYPES[code])
        self._at += count * dtype.itemsize
        return values

    def at_end(self) -> bool:
        return self._at >= len(self._data)


class AsciiReader:
    def __init__(self, data: bytes) -> None:
        self._data = data
        self._at = 0

    def take(self, layout: str) -> tuple[Any, ...]:
        """The next values; REALs come as floats."""
        return tuple(_parse(self._token(), code) for code in layout)

    def _token(self) -> bytes:
        if self.at_end():
            raise _too_short(self._data, self._at)
        end = self._data.find(b" ", self._at)
        token = self._data[self._at : end if end >= 0 else len(self._data)]
        self._at += len(token) + 1
        return token

    def characters(self, count: int) -> str:
        """A text of fixed length."""
        text = self._data[self._at : self._at + count]
        self._at += count
        if len(text) < count or self._data[self._at : self._at + 1] not in (b"", b" "):
            raise ColaError(f"text of {count} characters ends early at byte {self._at}")
        self._at += 1
        return text.decode(ENCODING)

    def text(self) -> str:
        (count,) = self.take("H")
        return self.characters(count) if count else ""

    def array(self, code: str, count: int) -> Array:
        """(count,) values of one type."""
        if count == 0:
            return np.empty(0, DTYPES[code])
        dtype = np.dtype(DTYPES[code]).newbyteorder(">")
        tokens = self._data[self._at :].split(b" ", count)[:count]
        self._at += sum(map(len, tokens)) + count
        try:
            image = bytes.fromhex(b"".join([token.rjust(2 * dtype.itemsize, b"0") for token in tokens]).decode())
        except ValueError as error:
            raise ColaError(f"a value before byte {self._at} is not hexadecimal") from error
        if len(tokens) < count or b"" in tokens or len(image) != count * dtype.itemsize:
            raise ColaError(f"{count} values announced; before byte {self._at} one is missing or too large")
        return np.frombuffer(image, dtype).astype(DTYPES[code])

    def at_end(self) -> bool:
        return self._at >= len(self._data)


class BinaryWriter:
    def __init__(self, command: str) -> None:
        self._parts = [command.encode() + (b"" if command == "sFA" else b" ")]

    def put(self, layout: str, *values: float) -> None:
        self._parts.append(struct.pack(f">{layout}", *values))

    def characters(self, text: str) -> None:
        self._parts.append(text.encode(ENCODING))

    def text(self, text: str) -> None:
        self.put("H", len(text))
        self.characters(text)

    def array(self, values: Array) -> None:
        self._parts.append(values.astype(values.dtype.newbyteorder(">")).tobytes())

    def payload(self) -> bytes:
        """Requests without arguments go without the blank behind the name, replies with it."""
        if len(self._parts) == 1 and self._parts[0][2:3] == b"N":
            return self._parts[0].rstrip()
        return b"".join(self._parts)


class AsciiWriter:
    def __init__(self, command: str) -> None:
        self._parts = [command.encode()]
        self._hexadecimal = hexadecimal()  # here, so that no scan waits for the making of the table

    def put(self, layout: str, *values: float) -> None:
        for code, value in zip(layout, values, strict=True):
            image = struct.pack(f">{code}", value)  # two's complement of the width, and refuses what does not fit
            digits = b"%08X" if code == "f" else b"%X"
            self._parts.append(digits % int.from_bytes(image))

    def characters(self, text: str) -> None:
        encoded = text.encode(ENCODING)
        if STX in encoded or ETX in encoded:
            raise ValueError(f"CoLa A cannot carry {text!r}")
        self._parts.append(encoded)

    def text(self, text: str) -> None:
        self.put("H", len(text))
        if text:
            self.characters(text)

    def array(self, values: Array) -> None:
        self._parts += self._hexadecimal[values].tolist()

    def payload(self) -> bytes:
        return b" ".join(self._parts)


Reader = BinaryReader | AsciiReader
Writer = BinaryWriter | AsciiWriter


def open_reader(dialect: Dialect, arguments: bytes) -> Reader:
    """Reads what stands behind the command."""
    return BinaryReader(arguments) if dialect is Dialect.B else AsciiReader(arguments)


def open_writer(dialect: Dialect, command: str) -> Writer:
    return BinaryWriter(command) if dialect is Dialect.B else AsciiWriter(command)


@cache
def hexadecimal() -> NDArray[np.bytes_]:
    """(65536,) the digits of each 16-bit number; looking them up takes a tenth of the time that writing them takes."""
    return np.array([b"%X" % number for number in range(65536)])


def _parse(token: bytes, code: str) -> Any:
    """One number of CoLa A."""
    if NUMBER.match(token) is None:
        raise ColaError(f"{token[:20]!r} is no number")
    try:
        if token[:1] in b"+-":
            struct.pack(f">{code}", int(token))
            return int(token)
        return struct.unpack(f">{code}", int(token, 16).to_bytes(struct.calcsize(f">{code}")))[0]
    except (struct.error, OverflowError) as error:
        raise ColaError(f"{token.decode()} does not fit its field") from error


def _too_short(data: bytes, at: int) -> ColaError:
    return ColaError(f"telegram ends early: {len(data)} bytes of arguments, more needed at byte {at}")
