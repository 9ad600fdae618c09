"""A drive as it was and as it comes back from a replay, which tests change, write and compare."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from rtlog_client.compare import Comparison
from rtlog_client.log_file import LogWriter
from rtlog_client.replay_report import PlayedFault, ReplayReport, Stall
from rtlog_server.messages import JointState, LaserScan, TagRead, TagReads, Tick, encode, header, to_ns, to_time
from rtlog_server.topics import JOINT_STATES, PRIMARY_SCAN, TAGS, TICK

MS = 1_000_000
PERIOD = 100 * MS
START = 1_700_000_000_000_000_000
OFFSET = 95_000_000_000_000_000
TICKS = 60
BEAMS = 11
NOTHING = np.empty(0)
PROFILE = """
schema = 1
name = "bench"
vehicle = { kinematics = "differential", track_width_m = 1.6 }
encoder_bus = { kind = "sei", port = "/tmp/x" }
rfid = { device = { host = "127.0.0.1" } }
[lasers.primary]
device = { host = "127.0.0.1" }
[[encoders]]
name = "left"
role = "left_wheel"
wheel_radius_m = 0.35
address = 0
[[encoders]]
name = "right"
role = "right_wheel"
wheel_radius_m = 0.35
address = 1
"""
SCAN = PRIMARY_SCAN.name
JOINTS = JOINT_STATES.name
READS = TAGS.name

Rows = dict[tuple[str, int], Any]  # topic and tick: content
Compare = Callable[..., Comparison]


def scan(k: int, stamp_ns: int) -> Any:
    ranges = np.float32(1 + (np.arange(BEAMS) * 7 + k * 13) % 101 / 10)
    return LaserScan(header(stamp_ns, ""), -1.0, 0.0, 0.1, 0.0, 0.02, 0.016, 20.0, ranges, np.float32(NOTHING))


def joints(elapsed_s: float, stamp_ns: int, turns: int = 0) -> Any:
    angles = np.array([4 * elapsed_s, 3 * elapsed_s + math.tau * turns])
    return JointState(header(stamp_ns, ""), ["left", "right"], angles, NOTHING, NOTHING)


def rows(offset_ns: int = 0, turns: int = 0) -> Rows:
    """A drive, as it was (offset 0) and as it is replayed."""
    found: Rows = {}
    for k in range(TICKS):
        tick_ns = START + offset_ns + k * PERIOD
        reads = [TagRead(to_time(tick_ns - 30 * MS), "E200", 0, 2, -40.0)] if 20 <= k < 30 else []
        found[TICK.name, k] = Tick(header(tick_ns, ""), k, to_time(tick_ns), 1e-5, [])
        found[PRIMARY_SCAN.name, k] = scan(k, tick_ns - 30 * MS)
        found[JOINT_STATES.name, k] = joints(k * 0.1 - 0.01, tick_ns - 10 * MS, turns)
        found[TAGS.name, k] = TagReads(header(tick_ns, ""), reads)
    return found


def write(path: Path, found: Rows, offset_ns: int, sequences: dict[tuple[str, int], int] | None = None) -> None:
    path.unlink(missing_ok=True)
    topics = {topic.name: topic for topic in (TICK, PRIMARY_SCAN, JOINT_STATES, TAGS)}
    with LogWriter(path, {"vehicle": "bench"}, PROFILE) as log:
        for (name, k), message in sorted(found.items(), key=lambda row: row[0][1]):
            tick_ns, stamp_ns = START + offset_ns + k * PERIOD, to_ns(message.header.stamp)
            number = None if sequences is None else sequences[name, k]
            log.write(name, topics[name].msgtype, encode(message), tick_ns, stamp_ns, number)


def report(*faults: PlayedFault, stalls: tuple[Stall, ...] = ()) -> ReplayReport:
    end_ns = START + (TICKS - 1) * PERIOD
    return ReplayReport(OFFSET, START, end_ns, TICKS, 0, 10, faults=list(faults), stalls=list(stalls))


def fault(kind: str, device: str, first: int, last: int) -> PlayedFault:
    """From tick to tick."""
    host_ns = START + OFFSET
    return PlayedFault(device, kind, host_ns + first * PERIOD, host_ns + last * PERIOD)


def found(comparison: Comparison, name: str) -> list[tuple[str, int, str]]:
    """What, tick, cause."""
    device = next(device for device in comparison.devices if device.device == name)
    return [(difference.what, difference.tick, difference.cause) for difference in device.differences]


def lose(topic: str, *ticks: int) -> Callable[[Rows], None]:
    def change(out: Rows) -> None:
        for k in ticks:
            del out[topic, k]

    return change
