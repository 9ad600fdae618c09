"""Are the scans that came out those that went in? To the wire's resolution, each in its tick, with its stamp.

    went in      s0   s1   s2   s3   s4   s5
    ticks     ───────────┼──────────────┼─────      a tick takes the newest of its scans:
    came out            s1             s4           s0, s2 and s3 are superseded; s1 and s4 the same

In: two recordings and the straight line between their times. Out: a `DeviceComparison`. Both are read as streams, a
fraction of a second at a time.
"""

import sys
from bisect import bisect_left
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtlog_client.difference import (
    TRANSIT_NS,
    Cause,
    Causes,
    DeviceComparison,
    Difference,
    gap_causes,
    hole_causes,
)
from rtlog_client.drive_log import TOPICS, Event
from rtlog_client.log_file import LoggedMessage, read_messages
from rtlog_client.replay_report import ReplayReport
from rtlog_client.ticks_out import TicksOut
from rtlog_server.devices.lms111.emulated_sweep import quantise_ranges
from rtlog_server.messages import decode, to_ns

WINDOW_NS = 100_000_000  # a scan that came out is looked for so far around its stamp
STAMP_NS = 5_000_000  # tolerance
ANGLE_RAD = np.radians(2e-4)  # the wire has 1/10000°
SILENCE_NS = 450_000_000  # after half a second the driver wonders what its scanner does


@dataclass(frozen=True, slots=True)
class _Scan:
    number: int
    stamp_ns: int  # UTC of the host
    duration_turns: float
    distances: NDArray[np.uint16]  # mm or a code, as on the wire
    angles: tuple[float, float]  # of the first ray, from ray to ray
    intensities: NDArray[np.float64]


def compare_scans(
    device: str,
    went_in: Iterable[Event],
    came_out: Path,
    report: ReplayReport,
    ticks: TicksOut,
    causes: Causes,
    turn_s: float,
    delay_ns: int = 0,
) -> DeviceComparison:
    """Of the scanner that measured them the second time, `turn_s` is a turn of the head, and `delay_ns` what it takes
    from the last ray to the transmission."""
    result = DeviceComparison(device)
    numbered = enumerate(went_in)
    matcher = _Matcher(_scan(number, report.host_ns(event.stamp_ns), event.content) for number, event in numbered)
    positions: list[int] = []
    sequences: list[int] = []
    extra: list[tuple[_Scan, int]] = []
    for message in read_messages(came_out, [TOPICS[device][0]]):
        position = ticks.position(message.log_time_ns)
        positions.append(position)
        sequences.append(message.sequence)
        scan = _scan_out(message)
        if not matcher.match(scan, position):
            extra.append((scan, position))
    matcher.finish()
    stamps_ns = np.array(matcher.stamps_ns, np.int64)
    own: list[Cause] = hole_causes(device, positions, sequences, ticks) + gap_causes(device, stamps_ns, SILENCE_NS)
    causes = causes.also(own)
    complete_ns = stamps_ns + delay_ns + np.round(np.array(matcher.turns) * turn_s * 1e9).astype(np.int64)
    extra = [late for late in extra if not matcher.note_changed(*late)]
    _judge_scans(result, matcher, complete_ns, report, ticks, causes)
    for scan, position in extra:
        if stamps_ns.size and stamps_ns[0] - STAMP_NS <= scan.stamp_ns <= stamps_ns[-1] + STAMP_NS:
            cause = causes.of(device, scan.stamp_ns, (scan.stamp_ns, ticks.at(position)), ticks.at(position))
            stamp_ns = report.recorded_ns(scan.stamp_ns)
            result.differences.append(Difference(device, "extra", ticks.index(position), stamp_ns, cause))
    return result


class _Matcher:
    """Finds for each scan that came out the one that went in; keeps of those no more than their times."""

    def __init__(self, scans_in: Iterator[_Scan]) -> None:
        self.stamps_ns: list[int] = []  # of all that went in; UTC of the host
        self.turns: list[float] = []  # that they took
        self.position: dict[int, int] = {}  # number: tick in which it came out
        self.error_ns: dict[int, int] = {}  # number: stamp out minus stamp in
        self.changed: set[int] = set()  # of these, with other content
        self._scans_in = scans_in
        self._window: deque[_Scan] = deque()
        self._next: _Scan | None = None
        self._take_next()

    def match(self, scan: _Scan, position: int) -> bool:
        while self._next is not None and self._next.stamp_ns <= scan.stamp_ns + WINDOW_NS:
            self._window.append(self._next)
            self._take_next()
        while self._window and self._window[0].stamp_ns < scan.stamp_ns - WINDOW_NS:
            self._window.popleft()
        if self.stamps_ns and scan.stamp_ns < self.stamps_ns[0] - STAMP_NS:
            return False  # of the vehicle standing before the start
        for candidate in sorted(self._window, key=lambda known: abs(known.stamp_ns - scan.stamp_ns)):
            if candidate.number not in self.position and _same(candidate, scan):
                self.position[candidate.number] = position
                self.error_ns[candidate.number] = scan.stamp_ns - candidate.stamp_ns
                return True
        return False

    def note_changed(self, scan: _Scan, position: int) -> bool:
        """After all else is matched: is this the scan of its time, with other content?"""
        after = bisect_left(self.stamps_ns, scan.stamp_ns)
        near = [k for k in (after - 1, after) if 0 <= k < len(self.stamps_ns) and k not in self.position]
        near = [k for k in near if abs(self.stamps_ns[k] - scan.stamp_ns) <= STAMP_NS]
        for number in near[:1]:
            self.changed.add(number)
            self.position[number] = position
            self.error_ns[number] = scan.stamp_ns - self.stamps_ns[number]
        return bool(near)

    def finish(self) -> None:
        while self._next is not None:
            self._take_next()

    def _take_next(self) -> None:
        self._next = next(self._scans_in, None)
        if self._next is not None:
            self.stamps_ns.append(self._next.stamp_ns)
            self.turns.append(self._next.duration_turns)


def _judge_scans(
    result: DeviceComparison,
    matcher: _Matcher,
    complete_ns: NDArray[np.int64],
    report: ReplayReport,
    ticks: TicksOut,
    causes: Causes,
) -> None:
    """What became of each scan that went in, from the last to the first."""
    result.went_in = len(complete_ns)
    expected = ticks.first_after(complete_ns)
    latest = ticks.first_after(complete_ns + TRANSIT_NS)  # of one that is complete just before its tick
    newer = sys.maxsize  # the tick in which a newer one came out
    for number in range(len(complete_ns) - 1, -1, -1):
        stamp_ns, position = matcher.stamps_ns[number], matcher.position.get(number)
        what = detail = ""
        if position is None:
            if newer <= latest[number]:
                result.superseded += 1
                continue
            what = "lost"
        else:
            newer = position
            error_ns = matcher.error_ns[number]
            result.same += number not in matcher.changed
            if number in matcher.changed:
                what = "changed"
            elif position > latest[number]:
                what, detail = "late", f"{position - expected[number]} ticks"
            elif abs(error_ns) > STAMP_NS:
                what, detail = "stamp", f"{error_ns * 1e-6:+.2f} ms"
        if what:
            tick = int(expected[number])
            due_ns = int(complete_ns[number])
            cause = causes.of(result.device, stamp_ns, (due_ns, due_ns), ticks.at(int(latest[number])))
            recorded_ns = report.recorded_ns(stamp_ns)
            result.differences.append(Difference(result.device, what, ticks.index(tick), recorded_ns, cause, detail))
    result.differences.reverse()
    errors_ms = np.abs(list(matcher.error_ns.values())) * 1e-6
    if errors_ms.size:
        for name, share in (("p50", 50), ("p99", 99), ("max", 100)):
            result.figures[f"stamp_error_ms_{name}"] = round(float(np.percentile(errors_ms, share)), 3)


def _same(a: _Scan, b: _Scan) -> bool:
    near = all(abs(x - y) <= ANGLE_RAD for x, y in zip(a.angles, b.angles, strict=True))
    return near and np.array_equal(a.distances, b.distances) and np.array_equal(a.intensities, b.intensities)


def _scan_out(message: LoggedMessage) -> _Scan:
    content = decode(message.data, message.msgtype)
    return _scan(-1, to_ns(content.header.stamp), content)


def _scan(number: int, stamp_ns: int, content: Any) -> _Scan:
    """As it is on the wire: whole millimetres, counter-clockwise."""
    ranges, intensities = np.asarray(content.ranges, np.float64), np.asarray(content.intensities, np.float64)
    start, step = content.angle_min, content.angle_increment
    if step < 0:
        ranges, intensities, start, step = ranges[::-1], intensities[::-1], start + (len(ranges) - 1) * step, -step
    remission = np.clip(np.round(np.nan_to_num(intensities)), 0, 65535).astype(np.float64)
    turns = max(len(ranges) - 1, 0) * step / (2 * np.pi)
    return _Scan(number, stamp_ns, turns, quantise_ranges(ranges), (start, step), remission)
