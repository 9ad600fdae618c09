"""One run of the server, from its start to its end, as one recording.

In: samples and heartbeats that carry the boot id of this run, in any order, also twice or not at all. Out: an MCAP with
every sample once, and in the metadata record `rtlog.loss` what never came. No network and no threads here.

log_time is when the sample's tick was scheduled, as that Tick message says. If it was lost: the time of the nearest
tick known, and a tick period for each tick between them. What comes before the first Tick waits for it.
"""

import json
import logging
import struct
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from uuid import UUID

from rtlog_client.holes import SequenceHoles
from rtlog_client.log_file import LOSS_NAME, LogWriter
from rtlog_server.attachment import Attachment
from rtlog_server.messages import decode, to_ns
from rtlog_server.topics import TAGS, TICK, Topic

log = logging.getLogger(__name__)

TICKS_REMEMBERED = 600
EARLY_SAMPLES = 1000  # that may wait for the first Tick
SHOWN_HOLES = 5
_STAMP = struct.Struct("<iI")  # a header's stamp: seconds, nanoseconds; after the 4 bytes of CDR encapsulation


@dataclass(frozen=True, slots=True)
class RunSummary:
    path: Path
    boot_id: str
    ticks: int
    messages: dict[str, int]  # recorded, per topic
    lost: dict[str, int]  # published and never seen, per topic
    size_bytes: int


@dataclass(frozen=True, slots=True)
class LastTag:
    epc: str
    stamp_ns: int


class RunLog:
    """The recording of the server's run `boot_id`; its file is opened with the first Tick.

    Args:
        open_log: makes the file.
        period_ns: from one tick to the next.
    """

    def __init__(self, boot_id: UUID, open_log: Callable[[], LogWriter], period_ns: int) -> None:
        self.boot_id = boot_id
        self.log: LogWriter | None = None
        self.sensors: dict[str, int] = {}  # states, from the newest Tick
        self.last_tag: LastTag | None = None
        self.newest_tick_ns = 0
        self._open_log = open_log
        self._period_ns = period_ns
        self._holes: dict[str, SequenceHoles] = {}
        self._told_lost: dict[str, int] = {}
        self._heard_heartbeat = False
        self._scheduled_ns: dict[int, int] = {}  # of the last ticks
        self._early: deque[tuple[Topic, bytes, Attachment]] = deque(maxlen=EARLY_SAMPLES)

    def add(self, topic: Topic, data: bytes, attachment: Attachment) -> None:
        """Record a sample, if it is new. Raises: ValueError: its bytes are no message."""
        if len(data) < 4 + _STAMP.size:
            raise ValueError(f"{len(data)} bytes are no {topic.msgtype}")
        content: Any = decode(data, topic.msgtype) if topic in (TICK, TAGS) else None
        if topic.name not in self._holes:
            self._holes[topic.name] = SequenceHoles(0 if self._heard_heartbeat else attachment.sequence)
        if not self._holes[topic.name].add(attachment.sequence):
            return
        if topic is TICK:
            self._note_tick(attachment.tick, content)
        elif topic is TAGS:
            for read in content.reads:
                self.last_tag = LastTag(read.epc, to_ns(read.stamp))
        if self.log is None:
            self._early.append((topic, data, attachment))
        else:
            self._write(self.log, topic, data, attachment)

    def heartbeat(self, last_sequence: dict[str, int]) -> None:
        """The server says what it has published; before the first time, that is not ours to miss."""
        for topic, last in last_sequence.items():
            if topic not in self._holes:
                self._holes[topic] = SequenceHoles(0 if self._heard_heartbeat else last + 1)
            self._holes[topic].published_up_to(last)
        self._heard_heartbeat = True

    def _note_tick(self, index: int, tick: Any) -> None:
        self._scheduled_ns[index] = to_ns(tick.scheduled)
        if len(self._scheduled_ns) > TICKS_REMEMBERED:
            del self._scheduled_ns[next(iter(self._scheduled_ns))]
        self.newest_tick_ns = max(self.newest_tick_ns, self._scheduled_ns[index])
        self.sensors = {sensor.name: sensor.state for sensor in tick.sensors}
        if self.log is None:
            self.log = self._open_log()
            while self._early:
                self._write(self.log, *self._early.popleft())

    def _write(self, log_file: LogWriter, topic: Topic, data: bytes, attachment: Attachment) -> None:
        seconds, nanoseconds = _STAMP.unpack_from(data, 4)
        stamp_ns = max(0, seconds * 1_000_000_000 + nanoseconds)
        log_time_ns = self._tick_time(attachment.tick)
        log_file.write(topic.name, topic.msgtype, data, log_time_ns, stamp_ns, attachment.sequence)

    def _tick_time(self, index: int) -> int:
        if index in self._scheduled_ns:
            return self._scheduled_ns[index]
        nearest = min(self._scheduled_ns, key=lambda known: abs(known - index))
        return max(0, self._scheduled_ns[nearest] + (index - nearest) * self._period_ns)

    @property
    def received(self) -> dict[str, int]:
        return {topic: holes.received for topic, holes in sorted(self._holes.items())}

    @property
    def lost(self) -> dict[str, int]:
        return {topic: holes.lost for topic, holes in sorted(self._holes.items()) if holes.lost}

    def tell_losses(self) -> None:
        """One line for each topic that has lost more than when this was called last."""
        for topic, count in self.lost.items():
            new = count - self._told_lost.get(topic, 0)
            if new > 0:
                ranges = [f"{a}" if a == b else f"{a}–{b}" for a, b in self._holes[topic].holes]
                shown = ", ".join(ranges[-SHOWN_HOLES:])
                log.warning("lost %d of %s (%d in all), last sequence numbers %s", new, topic, count, shown)
            self._told_lost[topic] = count

    def finish(self) -> RunSummary | None:
        """Write what was lost, and the index; None if not one Tick came, then there is no file either."""
        self.tell_losses()
        if self.log is None:
            if self._early:
                log.warning("%d messages came, but no Tick: nothing recorded", len(self._early))
            return None
        record = {
            topic: json.dumps({"received": holes.received, "lost": holes.lost, "holes": holes.holes})
            for topic, holes in sorted(self._holes.items())
        }
        self.log.add_metadata(LOSS_NAME, record)
        self.log.finish()
        path = self.log.path
        ticks = self.received[TICK.name]
        return RunSummary(path, str(self.boot_id), ticks, self.received, self.lost, path.stat().st_size)
