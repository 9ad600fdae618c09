"""What a replay takes from a recording: its span, its scans and tag reads in the order of their stamps, its wheels.

In: a recording. Out: `Span`, `Event`s, a `JointTrack`. All times are nanoseconds UTC of the recording. Scans and reads
are read as they are needed, a second ahead, so that a recording of any length can be replayed.
"""

import heapq
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hw_profiles.errors import BadInputError
from rtlog_client.log_file import read_info, read_messages
from rtlog_server.messages import decode, to_ns
from rtlog_server.topics import JOINT_STATES, TAGS

REORDER_NS = 1_000_000_000  # no sample was recorded later than this after its stamp


@dataclass(frozen=True, slots=True)
class Span:
    """What of the recording is replayed."""

    start_ns: int
    end_ns: int
    first_tick_ns: int  # of the recording


@dataclass(frozen=True, slots=True, order=True)
class Event:
    stamp_ns: int
    order: int  # in the recording
    topic: str = field(compare=False)
    content: Any = field(compare=False)  # a LaserScan, or one TagRead


@dataclass(frozen=True, slots=True)
class JointTrack:
    """Recorded positions of the encoders, and in between."""

    start_ns: int
    elapsed_ns: NDArray[np.float64]  # (N,) since the start, ascending; a float cannot hold the nanoseconds since 1970
    positions_rad: dict[str, NDArray[np.float64]]  # name: (N,), without jumps at ±π

    def angle(self, name: str, recorded_ns: int) -> float:
        """Linear from reading to reading; before the first and after the last the wheel stands still."""
        return float(np.interp(recorded_ns - self.start_ns, self.elapsed_ns, self.positions_rad[name]))


def read_span(recording: Path, start_s: float, duration_s: float | None) -> Span:
    """From `start_s` after its start, `duration_s` long (None: to the end). Raises: BadInputError: nothing is left."""
    info = read_info(recording)
    start_ns = info.start_ns + round(start_s * 1e9)
    end_ns = info.end_ns if duration_s is None else min(info.end_ns, start_ns + round(duration_s * 1e9))
    if start_ns >= end_ns:
        length_s = (info.end_ns - info.start_ns) * 1e-9
        raise BadInputError(f"{recording}: nothing to replay after {start_s:g} s; it is {length_s:.1f} s long")
    return Span(start_ns, end_ns, info.start_ns)


def read_events(recording: Path, topics: Collection[str], span: Span) -> Iterator[Event]:
    """Scans and tag reads of the ticks within the span, in the order of their stamps."""
    waiting: list[Event] = []
    order = count()
    for message in read_messages(recording, list(topics)):
        if message.log_time_ns > span.end_ns:
            break
        if message.log_time_ns < span.start_ns:
            continue
        content = decode(message.data, message.msgtype)
        if message.topic == TAGS.name:
            found = [Event(to_ns(read.stamp), next(order), message.topic, read) for read in content.reads]
        else:
            found = [Event(to_ns(content.header.stamp), next(order), message.topic, content)]
        for event in found:
            heapq.heappush(waiting, event)
        while waiting and waiting[0].stamp_ns <= message.log_time_ns - REORDER_NS:
            yield heapq.heappop(waiting)
    while waiting:
        yield heapq.heappop(waiting)


def read_joint_track(recording: Path, names: Collection[str]) -> JointTrack:
    """The whole recording's. Raises: BadInputError: it lacks an encoder, or all of them."""
    stamps: list[int] = []
    rows: list[list[float]] = []
    for message in read_messages(recording, [JOINT_STATES.name]):
        state = decode(message.data, message.msgtype)
        position = dict(zip(state.name, state.position, strict=False))
        if missing := [name for name in names if name not in position]:
            there = ", ".join(state.name)
            raise BadInputError(f"{recording}: {JOINT_STATES.name} lacks {', '.join(missing)}; it has {there}")
        stamps.append(to_ns(state.header.stamp))
        rows.append([position[name] for name in names])
    if not rows:
        raise BadInputError(f"{recording}: no {JOINT_STATES.name} in it, and the profile has encoders")
    start_ns = min(stamps)
    elapsed_ns = np.array([stamp - start_ns for stamp in stamps], np.float64)
    ascending = np.argsort(elapsed_ns, kind="stable")
    columns = np.unwrap(np.array(rows)[ascending], axis=0).T
    return JointTrack(start_ns, elapsed_ns[ascending], dict(zip(names, columns, strict=True)))
