"""A drive as a recording that goes in at the wire: every scan another, wheels that turn unevenly, tags now and then."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rtlog_client.log_file import LogWriter
from rtlog_server.messages import (
    OK,
    JointState,
    LaserScan,
    SensorState,
    TagRead,
    TagReads,
    Tick,
    encode,
    header,
    to_time,
)
from rtlog_server.topics import JOINT_STATES, PRIMARY_SCAN, TAGS, TICK

START_NS = 1_700_000_000_000_000_000 + 37_000_000  # its ticks are not on whole tenths of a second
PERIOD_NS = 100_000_000
TURN_NS = 20_000_000  # of a scanner's head
SWEEP_NS = 15_000_000
BEFORE_TICK_NS = 10_000_000  # when the newest sweep of a tick is complete
LATCHED_NS = 12_000_000
READ_NS = 40_000_000  # before the tick
BEAMS = 541
EPCS = ("E2003411B802011526370494", "E2003411B802011526370495")
NOTHING = np.empty(0)
WALL_MM = np.random.default_rng(1).integers(500, 15_000, BEAMS).astype(np.float32)


@dataclass(frozen=True)
class Drive:
    """What the vehicle does: it weaves ahead, and each tag is read for a second in five.

    `scan_hz` 10: the scan of each tick, as our server records it; 50: all that a scanner measures.
    """

    seconds: float
    scan_hz: int = 10
    lasers: tuple[Any, ...] = (PRIMARY_SCAN,)
    gap: tuple[int, int] = (0, 0)  # ticks without scans, the last one excluded

    def write(self, path: Path) -> None:
        with LogWriter(path, {"vehicle": "bench"}, None) as log:
            for k in range(round(self.seconds * 1e9) // PERIOD_NS):
                tick_ns = START_NS + k * PERIOD_NS
                for topic, message, log_ns in [*self._scans(k, tick_ns), *_tick(k, tick_ns)]:
                    stamp_ns = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
                    log.write(topic.name, topic.msgtype, encode(message), log_ns, stamp_ns)

    def _scans(self, k: int, tick_ns: int) -> Iterator[tuple[Any, Any, int]]:
        per_tick = 0 if self.gap[0] <= k < self.gap[1] else self.scan_hz // 10
        for part in range(per_tick):
            first_ns = tick_ns - BEFORE_TICK_NS - SWEEP_NS - (per_tick - 1 - part) * TURN_NS
            for number, topic in enumerate(self.lasers):
                count = (k * per_tick + part) * len(self.lasers) + number
                scan = LaserScan(
                    header(first_ns, "laser"),
                    *(np.radians(-135.0), np.radians(135.0), np.radians(0.5), 0.02 / 720, 0.02, 0.016, 20.0),
                    *(ranges_m(count), np.float32(NOTHING)),
                )
                yield topic, scan, tick_ns if self.scan_hz == 10 else first_ns + SWEEP_NS


def ranges_m(count: int) -> Any:
    """(BEAMS,) of the scan of this number: no two within a while are alike."""
    millimetres = np.roll(WALL_MM, 7 * count)
    millimetres[count % BEAMS] = np.inf
    millimetres[0] = 1000 + count % 20_000
    return millimetres / np.float32(1000)


def wheel_angles(elapsed_s: float) -> list[float]:
    """Left and right, rad: a metre a second or so, never twice the same."""
    return [3.0 * elapsed_s + np.sin(elapsed_s), 3.0 * elapsed_s - 1.5 * np.sin(0.7 * elapsed_s)]


def _tick(k: int, tick_ns: int) -> Iterator[tuple[Any, Any, int]]:
    latched_ns = tick_ns - LATCHED_NS
    angles = np.array(wheel_angles((latched_ns - START_NS) * 1e-9))
    read = TagRead(to_time(tick_ns - READ_NS), EPCS[k // 50 % 2], 0, 1 + k % 3, -40.0 - k % 10)
    reads = [read] if k % 50 < 10 else []
    sensors = [SensorState(name, OK, 0.02) for name in ("laser/primary", "encoders", "rfid")]
    yield TICK, Tick(header(tick_ns, ""), k, to_time(tick_ns), 0.0, sensors), tick_ns
    yield (
        JOINT_STATES,
        JointState(header(latched_ns, ""), ["left_wheel", "right_wheel"], angles, NOTHING, NOTHING),
        tick_ns,
    )
    yield TAGS, TagReads(header(tick_ns, "rfid"), reads), tick_ns
