"""What a replay takes from a recording: its span, and its scans and tag reads in the order of their stamps.

In: a recording, ours or another system's. Out: `Span`, `Event`s. All times are nanoseconds UTC of the recording. Scans
and reads are read as they are needed, a second ahead, so that a recording of any length can be replayed.
"""

import heapq
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from typing import Any

from hw_profiles.errors import BadInputError
from rtlog_client.log_file import read_info, read_messages
from rtlog_server.messages import decode, to_ns
from rtlog_server.topics import AUXILIARY_SCAN, PRIMARY_SCAN, TAGS, TICK

# Topics of a device, by its name; of several, a recording holds one: other systems know a single `/scan`.
TOPICS = {
    "laser/primary": (PRIMARY_SCAN.name, "/scan"),
    "laser/auxiliary": (AUXILIARY_SCAN.name,),
    "rfid": (TAGS.name,),
}
REORDER_NS = 1_000_000_000  # no sample was recorded later than this after its stamp


@dataclass(frozen=True, slots=True)
class Span:
    """What of the recording is replayed."""

    start_ns: int
    end_ns: int
    first_tick_ns: int  # of the recording; without ticks, its start


@dataclass(frozen=True, slots=True, order=True)
class Event:
    stamp_ns: int
    order: int  # in the recording
    device: str = field(compare=False)
    content: Any = field(compare=False)  # a LaserScan, or one TagRead


def read_span(recording: Path, start_s: float, duration_s: float | None) -> Span:
    """From `start_s` after its start, `duration_s` long (None: to the end). Raises: BadInputError: nothing is left."""
    info = read_info(recording)
    start_ns = info.start_ns + round(start_s * 1e9)
    end_ns = info.end_ns if duration_s is None else min(info.end_ns, start_ns + round(duration_s * 1e9))
    if start_ns >= end_ns:
        length_s = (info.end_ns - info.start_ns) * 1e-9
        raise BadInputError(f"{recording}: nothing to replay after {start_s:g} s; it is {length_s:.1f} s long")
    first_tick = next(read_messages(recording, [TICK.name]), None)
    return Span(start_ns, end_ns, info.start_ns if first_tick is None else first_tick.log_time_ns)


def read_events(recording: Path, devices: Collection[str], span: Span) -> Iterator[Event]:
    """Scans and tag reads of the ticks within the span, in the order of their stamps."""
    there = read_info(recording).message_counts
    topics = {next((topic for topic in TOPICS[device] if there.get(topic)), ""): device for device in devices}
    waiting: list[Event] = []
    order = count()
    for message in read_messages(recording, list(topics)):
        if message.log_time_ns > span.end_ns:
            break
        if message.log_time_ns < span.start_ns:
            continue
        content, device = decode(message.data, message.msgtype), topics[message.topic]
        if device == "rfid":
            found = [Event(to_ns(read.stamp), next(order), device, read) for read in content.reads]
        else:
            found = [Event(to_ns(content.header.stamp), next(order), device, content)]
        for event in found:
            heapq.heappush(waiting, event)
        while waiting and waiting[0].stamp_ns <= message.log_time_ns - REORDER_NS:
            yield heapq.heappop(waiting)
    while waiting:
        yield heapq.heappop(waiting)
