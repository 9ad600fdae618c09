"""MCAP: write a recording so that nothing is lost, read one, whoever wrote it.

A recording in the making is `NAME.mcap.part`. The metadata and the profile come first in it; `sync` once a second makes
all that was written so far safe against a power cut; `finish` writes the index and gives the file its name.
Times are nanoseconds UTC: log_time is the tick's, publish_time the header stamp's (see the contract of recordings).
"""

import json
import os
import struct
from bisect import bisect_left
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import zip_longest
from pathlib import Path
from types import TracebackType
from typing import BinaryIO

from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Channel, Chunk, Schema
from mcap.stream_reader import get_chunk_data_stream
from mcap.summary import Summary
from mcap.writer import CompressionType, Writer

from hw_profiles.errors import BadInputError
from rtlog_server.messages import schema_text

METADATA_NAME = "rtlog"
LOSS_NAME = "rtlog.loss"  # topic: JSON {"received", "lost", "holes": [[first, last], …]}, sequence numbers
PROFILE_NAME = "profile.toml"
CHUNK_BYTES = 256 * 1024
STRETCH_BYTES = 16 * CHUNK_BYTES  # of messages, that are worth a process of their own
FOREVER_NS = 2**63
RECORD = struct.Struct("<BQ")  # MCAP: opcode, length of the content
MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log_time, publish_time; the rest is data


@dataclass(frozen=True, slots=True)
class LoggedMessage:
    topic: str
    msgtype: str
    data: bytes  # CDR
    log_time_ns: int
    publish_time_ns: int
    sequence: int


@dataclass(frozen=True, slots=True)
class LogInfo:
    run_id: str  # the file's stem where the metadata do not say
    metadata: dict[str, str]
    profile_toml: str | None
    message_counts: dict[str, int]  # per topic
    start_ns: int
    end_ns: int
    msgtypes: dict[str, str] = field(default_factory=dict)  # per topic
    lost: dict[str, int] = field(default_factory=dict)  # per topic, as the recorder counted; empty if it did not
    cuts_ns: tuple[int, ...] = ()  # log times that cut it into stretches of about STRETCH_BYTES; empty without an index


class LogWriter:
    """Writes `path`, a `*.mcap` that must not exist yet.

    Raises:
        BadInputError: the file or its part file exists already, or its folder cannot be written.
    """

    def __init__(self, path: Path, metadata: dict[str, str], profile_toml: str | None) -> None:
        self.path = path
        self.part = path.with_name(path.name + ".part")
        if path.exists():
            raise BadInputError(f"{path} exists already; it is left as it is")
        try:
            self._file: BinaryIO = self.part.open("xb")
        except FileExistsError as error:
            hint = f"rtlog-client recover {self.part} mends what a cut-off recording left"
            raise BadInputError(f"{self.part} exists already; {hint}") from error
        except OSError as error:
            raise BadInputError(f"{self.part}: {error.strerror or error}") from error
        self._writer = Writer(self._file, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
        self._writer.start(profile="ros2", library="rtlog")
        if profile_toml is not None:
            now_ns = 0  # the attachment is part of the recording, not of a moment
            self._writer.add_attachment(now_ns, now_ns, PROFILE_NAME, "application/toml", profile_toml.encode())
        self._writer.add_metadata(METADATA_NAME, {"run_id": path.stem, **metadata})
        self._channels: dict[str, int] = {}
        self._sequences: dict[str, int] = {}
        self.sync()

    def write(
        self,
        topic: str,
        msgtype: str,
        data: bytes,
        log_time_ns: int,
        publish_time_ns: int,
        sequence: int | None = None,
    ) -> None:
        """Append one message; without a sequence number it gets the next of its topic."""
        if topic not in self._channels:
            self._channels[topic] = self._declare(topic, msgtype)
        if sequence is None:
            sequence = self._sequences.get(topic, 0)
        self._sequences[topic] = sequence + 1
        self._writer.add_message(self._channels[topic], log_time_ns, data, publish_time_ns, sequence & 0xFFFFFFFF)

    def _declare(self, topic: str, msgtype: str) -> int:
        """Declare a topic in the chunk at hand, and once more outside the chunks.

        A damaged chunk then takes only its own messages with it, not the means to read all that follow.
        """
        text = schema_text(msgtype).encode()
        schema = self._writer.register_schema(msgtype, "ros2msg", text)
        channel = self._writer.register_channel(topic, "cdr", schema)
        self._writer.flush()
        outside = RecordBuilder()
        Schema(schema, text, "ros2msg", msgtype).write(outside)
        Channel(channel, topic, "cdr", {}, schema).write(outside)
        self._file.write(outside.end())
        return int(channel)

    def add_metadata(self, name: str, record: dict[str, str]) -> None:
        """Append a metadata record of another name than `rtlog`, which is the first in the file."""
        self._writer.flush()
        self._writer.add_metadata(name, record)

    def sync(self) -> None:
        """Bring everything written so far to the disk."""
        self._writer.flush()
        self._file.flush()
        os.fdatasync(self._file.fileno())

    @property
    def size_bytes(self) -> int:
        return self._file.tell()

    def finish(self) -> None:
        """Write the index, sync, and give the file its name."""
        self._writer.finish()
        self._file.flush()
        os.fsync(self._file.fileno())
        self._file.close()
        self.part.rename(self.path)
        folder = os.open(self.path.parent, os.O_RDONLY)
        os.fsync(folder)
        os.close(folder)

    def abandon(self) -> None:
        """Close and remove the part file: for writers whose input turned out to be bad."""
        self._file.close()
        self.part.unlink(missing_ok=True)

    def __enter__(self) -> "LogWriter":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, _value: BaseException | None, _trace: TracebackType | None
    ) -> None:
        if kind is None:
            self.finish()
        else:
            self.abandon()


def _open(path: Path) -> BinaryIO:
    try:
        file = path.open("rb")
    except OSError as error:
        raise BadInputError(f"{path}: {error.strerror or error}") from error
    if path.stat().st_size == 0:
        file.close()
        raise BadInputError(f"{path}: the file is empty")
    return file


def _wrong(path: Path, error: Exception) -> BadInputError:
    with path.open("rb") as file:
        is_mcap = file.read(8) == b"\x89MCAP0\r\n"
    if not is_mcap:
        return BadInputError(f"{path}: not an MCAP recording")
    return BadInputError(f"{path}: cut off or damaged ({type(error).__name__}); rtlog-client recover {path} mends it")


def read_info(path: Path) -> LogInfo:
    """What the recording says about itself. Raises: BadInputError: missing, empty, no MCAP, or cut off."""
    with _open(path) as file:
        try:
            reader = make_reader(file)
            summary = reader.get_summary()
            records = {record.name: record.metadata for record in reader.iter_metadata()}
            profile = next((a.data.decode() for a in reader.iter_attachments() if a.name == PROFILE_NAME), None)
        except (McapError, ValueError, EOFError, OSError) as error:
            raise _wrong(path, error) from error
    if summary is None or summary.statistics is None:
        raise BadInputError(f"{path}: the recording has no index; rtlog-client recover {path} makes one")
    statistics, metadata = summary.statistics, records.get(METADATA_NAME, {})
    topics = {channel.id: channel.topic for channel in summary.channels.values()}
    counts = {topics[key]: count for key, count in statistics.channel_message_counts.items()}
    msgtypes = {c.topic: summary.schemas[c.schema_id].name for c in summary.channels.values() if c.schema_id}
    return LogInfo(
        run_id=metadata.get("run_id", path.stem),
        metadata=metadata,
        profile_toml=profile,
        message_counts=counts,
        start_ns=statistics.message_start_time,
        end_ns=statistics.message_end_time,
        msgtypes=msgtypes,
        lost={topic: int(json.loads(text)["lost"]) for topic, text in records.get(LOSS_NAME, {}).items()},
        cuts_ns=_cuts(summary),
    )


def _cuts(summary: Summary) -> tuple[int, ...]:
    cuts_ns, size = [], 0
    for start_ns, chunk_size in sorted((of.message_start_time, of.uncompressed_size) for of in summary.chunk_indexes):
        if size >= STRETCH_BYTES:
            cuts_ns.append(start_ns)
            size = 0
        size += chunk_size
    return tuple(cuts_ns)


def read_messages(
    path: Path, topics: list[str] | None = None, start_ns: int = 0, end_ns: int = FOREVER_NS
) -> Iterator[LoggedMessage]:
    """The messages with a log_time from `start_ns` to before `end_ns`, in its order; `topics` None: all.

    Raises: BadInputError as `read_info`, also midway.
    """
    with _open(path) as file:
        try:
            reader = make_reader(file, validate_crcs=True)
            summary = reader.get_summary()
            if summary is not None and summary.chunk_indexes:
                yield from _indexed_messages(file, summary, topics, start_ns, end_ns)
                return
            for schema, channel, message in reader.iter_messages(topics=topics, start_time=start_ns, end_time=end_ns):
                yield LoggedMessage(
                    channel.topic,
                    schema.name if schema else "",
                    message.data,
                    message.log_time,
                    message.publish_time,
                    message.sequence,
                )
        except (McapError, ValueError, EOFError, struct.error) as error:
            raise _wrong(path, error) from error


def _indexed_messages(
    file: BinaryIO, summary: Summary, topics: list[str] | None, start_ns: int, end_ns: int
) -> Iterator[LoggedMessage]:
    """The messages chunk by chunk: many times as fast as the library's queue. As there, messages of one log_time come
    in the order of the file.
    """
    channels = {
        channel.id: (channel.topic, summary.schemas[channel.schema_id].name if channel.schema_id else "")
        for channel in summary.channels.values()
        if topics is None or channel.topic in topics
    }
    chunks = [
        chunk
        for chunk in summary.chunk_indexes
        # some writers leave the index of a chunk's messages out: then it may hold any
        if (not chunk.message_index_offsets or channels.keys() & chunk.message_index_offsets.keys())
        and chunk.message_start_time < end_ns
        and chunk.message_end_time >= start_ns
    ]
    chunks.sort(key=lambda chunk: (chunk.message_start_time, chunk.chunk_start_offset))
    waiting: list[tuple[int, int, int, LoggedMessage]] = []  # what a chunk that is still to come may precede
    for chunk, following in zip_longest(chunks, chunks[1:]):
        file.seek(chunk.chunk_start_offset + 1 + 8)
        stream, size = get_chunk_data_stream(Chunk.read(ReadDataStream(file)), validate_crc=True)
        data, at = stream.read(size), 0
        while at < size:
            opcode, length = RECORD.unpack_from(data, at)
            at += RECORD.size
            if opcode == Opcode.MESSAGE:
                channel, sequence, log_ns, publish_ns = MESSAGE.unpack_from(data, at)
                if channel in channels and start_ns <= log_ns < end_ns:
                    content = data[at + MESSAGE.size : at + length]
                    message = LoggedMessage(*channels[channel], content, log_ns, publish_ns, sequence)
                    waiting.append((log_ns, chunk.chunk_start_offset, at, message))
            at += length
        waiting.sort(key=lambda of: of[:3])
        ready = len(waiting)
        if following is not None:
            ready = bisect_left(
                waiting, (following.message_start_time, following.chunk_start_offset), key=lambda of: of[:2]
            )
        for *_, message in waiting[:ready]:
            yield message
        del waiting[:ready]
