"""Were the same tags read, as often, at the same time?

    went in      2 1   3      2   reads of one tag by one antenna
    came out         3      5     each entry holds all since the one before: 2 + 1; then 3 + 2, the 3 of these late

In: two recordings. Out: a `DeviceComparison`. An entry takes the newest reads that make up its count; older ones that
no entry has room for are lost.
"""

from collections import defaultdict, deque
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rtlog_client.difference import Causes, DeviceComparison, Difference, hole_causes
from rtlog_client.drive_log import Span, read_events
from rtlog_client.log_file import read_messages
from rtlog_client.replay_report import ReplayReport
from rtlog_client.ticks_out import TicksOut
from rtlog_server.messages import decode, to_ns
from rtlog_server.topics import TAGS

STAMP_NS = 25_000_000  # tolerance: a reader's stamp is when its line came; with short ticks less
STAMP_TICKS = 0.4
RSSI = 0.05

Key = tuple[str, int]  # EPC, antenna


@dataclass(frozen=True, slots=True)
class _Read:
    stamp_ns: int  # UTC of the host
    count: int
    rssi: float
    position: int = 0  # of the tick where it came out


def compare_tags(
    went_in: tuple[Path, Span], came_out: Path, report: ReplayReport, ticks: TicksOut, causes: Causes
) -> DeviceComparison:
    result = DeviceComparison("rfid")
    reads_in: dict[Key, deque[_Read]] = defaultdict(deque)
    for event in read_events(went_in[0], ["rfid"], went_in[1]):
        read = event.content
        reads_in[read.epc, read.antenna].append(_Read(report.host_ns(event.stamp_ns), max(1, read.count), read.rssi))
    result.went_in = sum(map(len, reads_in.values()))
    reads_out: dict[Key, list[_Read]] = defaultdict(list)
    positions: list[int] = []
    sequences: list[int] = []
    for message in read_messages(came_out, [TAGS.name]):
        position = ticks.position(message.log_time_ns)
        positions.append(position)
        sequences.append(message.sequence)
        for read in decode(message.data, message.msgtype).reads:
            reads_out[read.epc, read.antenna].append(_Read(to_ns(read.stamp), read.count, read.rssi, position))
    causes = causes.also(hole_causes("rfid", positions, sequences, ticks))
    start_ns, end_ns = report.host_ns(report.start_ns), report.host_ns(report.end_ns)
    found = [
        (stamp_ns, what, detail)
        for key in sorted(reads_in.keys() | reads_out.keys())
        for stamp_ns, what, detail in _differences(reads_in[key], reads_out[key], ticks.period_ns, result)
        if what != "extra" or start_ns - ticks.period_ns <= stamp_ns
    ]
    present = set(positions)
    first, last = ticks.position(start_ns), ticks.position(end_ns)
    found += [(ticks.at(k), "silent", "no message") for k in range(first, last + 1) if k not in present]
    for stamp_ns, what, detail in sorted(found):
        position = int(ticks.first_after(np.array([stamp_ns]))[0])
        cause = causes.of("rfid", stamp_ns, (stamp_ns, stamp_ns), ticks.at(position))
        recorded_ns = report.recorded_ns(stamp_ns)
        result.differences.append(Difference("rfid", what, ticks.index(position), recorded_ns, cause, detail))
    return result


def _differences(
    pending: deque[_Read], entries: list[_Read], period_ns: int, result: DeviceComparison
) -> Iterator[tuple[int, str, str]]:
    """Of one tag and antenna: stamp, what, detail. Counts in `result` what is the same."""
    epc_reads = deque(pending)
    tolerance_ns = min(STAMP_NS, STAMP_TICKS * period_ns)
    for entry in entries:
        waiting = []
        while epc_reads and epc_reads[0].stamp_ns <= entry.stamp_ns + tolerance_ns:
            waiting.append(epc_reads.popleft())
        room = entry.count
        taken: list[_Read] = []
        for read in reversed(waiting):
            if read.count > room:
                yield read.stamp_ns, "lost", f"{read.count - room} of {read.count} reads"
                room = 0
                continue
            room -= read.count
            taken.append(read)
        if room > 0:
            yield entry.stamp_ns, "extra", f"{room} of {entry.count} reads"
        for read in taken:
            late_ns = entry.stamp_ns - read.stamp_ns
            newest = read is taken[0]
            if late_ns > tolerance_ns + (0 if newest else period_ns):
                yield read.stamp_ns, "late", f"{late_ns * 1e-6:.0f} ms"
            elif newest and not (abs(read.rssi - entry.rssi) <= RSSI or read.rssi != read.rssi):
                yield read.stamp_ns, "changed", f"RSSI {read.rssi:g}, now {entry.rssi:g}"
            else:
                result.same += newest
                result.superseded += not newest
    for read in epc_reads:
        yield read.stamp_ns, "lost", f"{read.count} reads"
