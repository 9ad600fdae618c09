"""Mend a recording: what a cut-off or damaged MCAP file still holds, into a new file with its index.

In: a damaged file, which is only read. Out: a finished recording with the same profile, metadata, topics, times and
sequence numbers, and a metadata record `rtlog.recovery` that says what it comes from.
Law: what was whole in the damaged file is in the new one, and nothing else. `LogWriter.sync` ends a chunk, so
everything synced before a cut is whole.
"""

import errno
import mmap
import os
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

from mcap import records
from mcap.opcode import Opcode
from mcap.writer import CompressionType, Writer

from hw_profiles.errors import BadInputError, RTLogError
from rtlog_client.log_file import CHUNK_BYTES
from rtlog_client.mcap_scan import MAGIC, Scan, open_chunk, parse_message, parse_record, scan_records

RECOVERY_NAME = "rtlog.recovery"


@dataclass(frozen=True, slots=True)
class Recovery:
    """What came back, and what did not."""

    path: Path
    messages: dict[str, int]  # per topic
    damaged_chunks: int  # left out: their content does not match their CRC
    orphans: int  # messages left out because the definition of their topic is lost
    skipped_bytes: int  # in no readable record: the cut tail, or what a bad block hit
    was_whole: bool  # the file was finished and undamaged


@dataclass(slots=True)
class _Contents:
    """The first pass: what is said outside the chunks, wherever in the file it stands."""

    header: records.Header = field(default_factory=lambda: records.Header("", ""))
    schemas: dict[int, records.Schema] = field(default_factory=dict)
    channels: dict[int, records.Channel] = field(default_factory=dict)
    metadata: list[records.Metadata] = field(default_factory=list)
    attachments: list[records.Attachment] = field(default_factory=list)
    chunks: int = 0

    def add(self, record: Any) -> None:
        match record:
            case records.Header():
                self.header = record
            case records.Schema():
                self.schemas.setdefault(record.id, record)
            case records.Channel():
                self.channels.setdefault(record.id, record)
            case records.Metadata():
                self.metadata.append(record)
            case records.Attachment():
                self.attachments.append(record)


def default_output(path: Path) -> Path:
    """NAME.mcap for NAME.mcap.part, else NAME.recovered.mcap."""
    return path.with_suffix("") if path.name.endswith(".mcap.part") else path.with_suffix(".recovered.mcap")


def recover(path: Path, output: Path | None = None, on_bytes: Callable[[int], Any] = lambda _: None) -> Recovery:
    """Write what is whole in `path` to `output` (None: `default_output`); `on_bytes` is told how far the reading is.

    Raises:
        BadInputError: no such file, empty, no MCAP, or the output exists already or cannot be written.
        RTLogError: there is no whole message in it, or the disk is full; nothing was written.
    """
    output = output or default_output(path)
    if output.exists():
        raise BadInputError(f"{output} exists already; it is left as it is (-o names another)")
    working = output.with_name(output.name + ".recovering")
    try:
        with path.open("rb") as file:
            if path.stat().st_size == 0:
                raise BadInputError(f"{path}: the file is empty")
            with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data, working.open("wb") as mended:
                recovery = _rebuild(path, data, output, mended, on_bytes)
                os.fsync(mended.fileno())
        working.rename(output)
    except OSError as error:
        kind = RTLogError if error.errno in (errno.ENOSPC, errno.EIO) else BadInputError
        raise kind(f"{error.filename or working}: {error.strerror or error}") from error
    finally:
        working.unlink(missing_ok=True)
    return recovery


def _rebuild(path: Path, data: mmap.mmap, output: Path, mended: BinaryIO, on_bytes: Callable[[int], Any]) -> Recovery:
    """Metadata and profile first, then every whole message in the order of the file."""
    contents = _read_contents(data)
    if not contents.chunks and data[: len(MAGIC)] != MAGIC:
        raise BadInputError(f"{path}: not an MCAP recording")
    writer = Writer(mended, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
    writer.start(contents.header.profile, contents.header.library)
    for item in contents.attachments:
        writer.add_attachment(item.create_time, item.log_time, item.name, item.media_type, item.data)
    for record in contents.metadata:
        writer.add_metadata(record.name, record.metadata)
    scan, copier, damaged, orphans = Scan(), _Copier(writer, contents), 0, 0
    for position, opcode, body in scan_records(data, scan):
        on_bytes(position)
        found: list[Any] | None = []
        if opcode == Opcode.CHUNK:
            found = open_chunk(body)
        elif opcode == Opcode.MESSAGE and not contents.chunks:  # in a file with chunks it would be debris
            found = [parse_message(body)]
        damaged += found is None
        orphans += sum(not copier.copy(record) for record in found or [])
    if not copier.counts:
        raise RTLogError(f"{path}: nothing to recover: no whole message in its {len(data)} bytes")
    on_bytes(len(data))
    damage = {"damaged_chunks": damaged, "orphans": orphans, "skipped_bytes": scan.skipped_bytes}
    writer.add_metadata(RECOVERY_NAME, {"source": path.name, **{key: str(count) for key, count in damage.items()}})
    writer.finish()
    mended.flush()
    was_whole = scan.finished and not any(damage.values())
    return Recovery(output, dict(copier.counts), damaged, orphans, scan.skipped_bytes, was_whole)


def _read_contents(data: mmap.mmap) -> _Contents:
    contents = _Contents()
    for _, opcode, body in scan_records(data, Scan()):
        contents.chunks += opcode == Opcode.CHUNK
        contents.add(parse_record(opcode, body))
    return contents


class _Copier:
    """Copies messages, and with the first of a topic its definition, under ids of the new file's own."""

    def __init__(self, writer: Writer, contents: _Contents) -> None:
        self.counts: Counter[str] = Counter()
        self._writer = writer
        self._contents = contents
        self._schemas = {0: 0}  # old id: new id; 0 means no schema
        self._channels: dict[int, int] = {}

    def copy(self, record: Any) -> bool:
        """Take in what a chunk holds, in its order; False for a message whose definition is lost."""
        if not isinstance(record, records.Message):
            self._contents.add(record)
            return True
        channel = self._contents.channels.get(record.channel_id)
        if channel is None or (channel.schema_id and channel.schema_id not in self._contents.schemas):
            return False
        if channel.schema_id not in self._schemas:
            schema = self._contents.schemas[channel.schema_id]
            self._schemas[schema.id] = self._writer.register_schema(schema.name, schema.encoding, schema.data)
        if channel.id not in self._channels:
            self._channels[channel.id] = self._writer.register_channel(
                channel.topic, channel.message_encoding, self._schemas[channel.schema_id], channel.metadata
            )
        self._writer.add_message(
            self._channels[channel.id], record.log_time, record.data, record.publish_time, record.sequence
        )
        self.counts[channel.topic] += 1
        return True
