"""Walk over a damaged MCAP file record by record, past the damage.

    magic  header  attachment  metadata  schema  channel  CHUNK  index  CHUNK  in|         cut at any byte
                                                          ^^^^^         ^^^^^              whole chunks with a right CRC

In: the bytes of a file that a power cut, a full disk or a bad block has damaged. Out: every record that is whole.
Law: after damage the walk goes on at the next chunk whose inner lengths make up its own. Layout: https://mcap.dev/spec
"""

import mmap
import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from typing import Any

import zstandard
from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.stream_reader import breakup_chunk

MAGIC = b"\x89MCAP0\r\n"
RECORD_HEADER = struct.Struct("<BQ")  # opcode, length of the body
CHUNK_HEADER = struct.Struct("<QQQII")  # start, end, uncompressed size, CRC, length of the compression's name
CHUNK_SIGNATURE = re.compile(rb"\x06.{8}.{28}(?:\x04\0\0\0zstd|\x03\0\0\0lz4|\0\0\0\0)", re.DOTALL)
KNOWN_OPCODES = {int(opcode) for opcode in Opcode}
PARSERS: dict[int, Any] = {
    Opcode.HEADER: records.Header,
    Opcode.SCHEMA: records.Schema,
    Opcode.CHANNEL: records.Channel,
    Opcode.METADATA: records.Metadata,
    Opcode.ATTACHMENT: records.Attachment,
}
# What the parsers and the two decompressors raise on damaged bytes
DAMAGE = (McapError, ValueError, RuntimeError, MemoryError, struct.error, zstandard.ZstdError)


@dataclass(slots=True)
class Scan:
    """What the walk met on its way."""

    skipped_bytes: int = 0  # in no readable record
    finished: bool = False  # it reached the end that a finished file has


def scan_records(data: mmap.mmap, scan: Scan) -> Iterator[tuple[int, int, bytes]]:
    """Every readable record as (position, opcode, body); tells `scan` what it met."""
    trusted = position = len(MAGIC) if data[: len(MAGIC)] == MAGIC else 0
    while position < len(data):
        body = _record_at(data, position)
        if body is None:  # search from the last place that was surely a record's end: this length may have lied
            restart = _next_chunk(data, trusted + 1)
            scan.skipped_bytes += restart - trusted
            trusted = position = restart
            continue
        opcode = data[position]
        yield position, opcode, body
        position += RECORD_HEADER.size + len(body)
        if opcode == Opcode.FOOTER:
            scan.finished = data[position:] == MAGIC
            return
        if opcode == Opcode.CHUNK or (position < len(data) and data[position] in KNOWN_OPCODES):
            trusted = position


def parse_record(opcode: int, body: bytes) -> Any | None:
    """A header, schema, channel, metadata or attachment record; None if it is another or damaged."""
    if opcode not in PARSERS:
        return None
    stream = ReadDataStream(BytesIO(body))
    try:
        record = PARSERS[opcode].read(stream)
    except DAMAGE:
        return None
    return record if stream.count == len(body) else None


def parse_message(body: bytes) -> records.Message:
    """A message that stands outside of chunks."""
    return records.Message.read(ReadDataStream(BytesIO(body)), len(body))


def open_chunk(body: bytes) -> list[Any] | None:
    """The schemas, channels and messages in a chunk, in their order; None if it is damaged."""
    try:
        return breakup_chunk(records.Chunk.read(ReadDataStream(BytesIO(body))), validate_crc=True)
    except DAMAGE:
        return None


def _record_at(data: mmap.mmap, position: int) -> bytes | None:
    """The body of the record that starts here; None if none does, or if it is cut off."""
    start = position + RECORD_HEADER.size
    if start > len(data):
        return None
    opcode, length = RECORD_HEADER.unpack_from(data, position)
    if opcode not in KNOWN_OPCODES or start + length > len(data):
        return None
    body = data[start : start + length]
    return body if opcode != Opcode.CHUNK or _adds_up(body) else None


def _adds_up(chunk: bytes) -> bool:
    """Do the lengths inside a chunk's body make up its own?"""
    if len(chunk) < CHUNK_HEADER.size + 8:
        return False
    start = CHUNK_HEADER.size + CHUNK_HEADER.unpack_from(chunk)[-1] + 8
    return start <= len(chunk) and len(chunk) == start + struct.unpack_from("<Q", chunk, start - 8)[0]


def _next_chunk(data: mmap.mmap, position: int) -> int:
    """Where the next whole chunk starts; the end of the file if there is none."""
    while match := CHUNK_SIGNATURE.search(data, position):
        if _record_at(data, match.start()) is not None:
            return match.start()
        position = match.start() + 1
    return len(data)
