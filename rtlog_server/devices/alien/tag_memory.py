"""What a reader's lines add to what it told before: new reads only, each with its time.

In: tags as the reader lists them, whose counts go on while they are on its list, from a stream and from polls, in any
order. Out: `TagSample`s. The law: a read counts once, by whatever way it is told first.

    stream    E200… 3 reads      E200… 4 reads
    poll                E200… 3 reads      E200… 6 reads     told: 3, 1, 2

When it was read: by the reader's clock, brought to ours by the fastest delivery of late; where that clock is wrong (it
starts in 1970) the time of reception.
"""

import time

from rtlog_server.devices.alien.tag_line import TagRead
from rtlog_server.devices.rfid import TagSample

MAX_TAGS = 4096  # the reads of so many tags are kept apart
WINDOW_NS = 15_000_000_000  # the fastest delivery of the last 15 to 30 s: two quartz clocks part by 3 ms in that time
EARLIEST_S = 15.0  # what a host that stood still may receive late
LATEST_S = 3.0  # a clock set to whole seconds, and its drift


class ReaderClock:
    """Brings the reader's milliseconds to the host's monotonic clock."""

    def __init__(self) -> None:
        self.right = True  # as far as the last tag tells
        self._window_start_ns = 0
        self._offsets: list[int | None] = [None, None]  # least receive minus reader time of this window, of the last

    def measured_ns(self, reader_ms: int | None, receive_ns: int, utc_ns: int) -> int:
        """When the reader saw a tag; `receive_ns` (monotonic) and `utc_ns` are when the host heard of it."""
        if reader_ms is None:
            return receive_ns
        self.right = -EARLIEST_S <= reader_ms * 1e-3 - utc_ns * 1e-9 <= LATEST_S
        if not self.right:
            self._offsets = [None, None]
            return receive_ns
        if receive_ns - self._window_start_ns > WINDOW_NS:
            self._window_start_ns = receive_ns
            self._offsets = [None, self._offsets[0]]
        offset_ns = receive_ns - reader_ms * 1_000_000
        self._offsets[0] = offset_ns if self._offsets[0] is None else min(self._offsets[0], offset_ns)
        least_ns = min(offset for offset in self._offsets if offset is not None)
        return reader_ms * 1_000_000 + least_ns


class TagMemory:
    """Remembers what was told of each tag at each antenna."""

    def __init__(self) -> None:
        self.clock = ReaderClock()
        self._told: dict[tuple[str, int], TagRead] = {}

    def take(self, tag: TagRead, receive_ns: int) -> TagSample | None:
        """What a line adds; None if all of it was told already."""
        reads = self._new_reads(tag)
        if not reads:
            return None
        measured_ns = self.clock.measured_ns(tag.last_seen_ms, receive_ns, time.time_ns())
        return TagSample(measured_ns, receive_ns, tag.epc, tag.antenna, reads, tag.rssi, tag.last_seen_ms)

    def _new_reads(self, tag: TagRead) -> int:
        key = tag.epc, tag.antenna
        before = self._told.get(key)
        if before is not None and tag.discovered_ms == before.discovered_ms:
            times = tag.last_seen_ms, before.last_seen_ms
            if times[0] is not None and times[1] is not None and (times[0], tag.count) <= (times[1], before.count):
                return 0
            reads = tag.count - before.count if tag.count > before.count else tag.count
        else:
            reads = tag.count
        self._told.pop(key, None)
        self._told[key] = tag  # at the end: the longest unread goes first
        if len(self._told) > MAX_TAGS:
            del self._told[next(iter(self._told))]
        return reads
