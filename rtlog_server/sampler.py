"""At a tick: what every device handed over since the last one, as the contract's messages.

    tick k-1          tick k                  a sample belongs to the first tick at or after its completion, by the
    ──┼───s──s──s──s──┼───s──s── time         scheduled time of the tick, also when that comes late
      └── collected ──┘

In: devices and a `TickTime`. Out: `Sample`s, the Tick first. Of scanner and encoders the newest of the tick is sent, of
the reader all of it, in one message. Monotonic nanoseconds come in, UTC goes out.

After the whole process stood still, the missed ticks hold what the drivers had handed over in time, and say STALE of a
device that nobody could hear: that is what was known. What still lay in sockets goes to the first tick after that.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from rtlog_server.bundle import DeviceReport, Sample
from rtlog_server.devices.device import Collected, Device
from rtlog_server.devices.encoders import EncoderReading
from rtlog_server.devices.laser import Scan
from rtlog_server.devices.rfid import TagSample
from rtlog_server.messages import (
    MISSING,
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
from rtlog_server.ticker import TickTime
from rtlog_server.topics import AUXILIARY_SCAN, JOINT_STATES, PRIMARY_SCAN, TAGS, TICK

MAX_COUNT = 65535  # TagRead.count is a uint16


class Sampler:
    def __init__(self, devices: Sequence[Device[Any]], utc_offset_ns: int) -> None:
        self._devices = devices
        self._utc_offset_ns = utc_offset_ns
        self._sequences: dict[str, int] = {}

    def sample(self, tick: TickTime) -> tuple[list[Sample], list[DeviceReport]]:
        """The messages of this tick, and how each device is."""
        scheduled_utc_ns = tick.scheduled_ns + self._utc_offset_ns
        messages = []
        reports = []
        for device in self._devices:
            collected = device.collect(tick.scheduled_ns)
            reports.append(_report(device, collected))
            topic, build = BUILDERS[device.name]
            message = build(collected, self._utc_offset_ns, scheduled_utc_ns)
            if message is not None:
                messages.append((topic.name, message))
        tick_message = Tick(
            header(tick.began_ns + self._utc_offset_ns, ""),
            tick.index,
            to_time(scheduled_utc_ns),
            tick.lateness_ns * 1e-9,
            [SensorState(report.name, report.state, report.age_s) for report in reports],
        )
        return [self._number(topic, encode(m)) for topic, m in [(TICK.name, tick_message), *messages]], reports

    def _number(self, topic: str, data: bytes) -> Sample:
        sequence = self._sequences.get(topic, 0)
        self._sequences[topic] = sequence + 1
        return Sample(topic, sequence, data)


def _report(device: Device[Any], collected: Collected[Any]) -> DeviceReport:
    return DeviceReport(
        device.name,
        collected.state,
        collected.age_s,
        device.message,
        device.connects,
        dict(device.identity),  # copies: the driver's thread goes on writing
        dict(device.diagnostics),
    )


def laser_scan(collected: Collected[Scan], utc_offset_ns: int, frame_id: str) -> Any | None:
    """A LaserScan of the newest scan, stamped with its first ray; None without one."""
    return scan_message(collected.samples[-1], utc_offset_ns, frame_id) if collected.samples else None


def scan_message(scan: Scan, utc_offset_ns: int, frame_id: str) -> Any:
    """A scan as a LaserScan, stamped with its first ray."""
    return LaserScan(
        header(scan.measured_ns + utc_offset_ns, frame_id),
        scan.angle_min_rad,
        scan.angle_min_rad + (len(scan.ranges_m) - 1) * scan.angle_increment_rad,
        scan.angle_increment_rad,
        scan.time_increment_s,
        scan.scan_time_s,
        scan.range_min_m,
        scan.range_max_m,
        np.asarray(scan.ranges_m, np.float32),
        np.asarray(scan.intensities, np.float32),
    )


def joint_state(collected: Collected[EncoderReading], utc_offset_ns: int) -> Any | None:
    """A JointState of the newest reading, stamped with its latch; None without one."""
    if not collected.samples:
        return None
    reading = collected.samples[-1]
    nothing = np.empty(0)
    positions = np.array(reading.positions_rad, np.float64)
    return JointState(header(reading.measured_ns + utc_offset_ns, ""), list(reading.names), positions, nothing, nothing)


def tag_reads(collected: Collected[TagSample], utc_offset_ns: int, scheduled_utc_ns: int) -> Any | None:
    """All reads since the last tick, one entry for a tag and antenna: their number, and stamp and RSSI of the newest.

    The header says the tick, as the end of that time. None while the reader does not answer.
    """
    if collected.state == MISSING and not collected.samples:  # what it read before it went is sent
        return None
    newest: dict[tuple[str, int], TagSample] = {}
    counts: dict[tuple[str, int], int] = {}
    for sample in collected.samples:
        key = sample.epc, sample.antenna
        counts[key] = counts.get(key, 0) + sample.count
        if key not in newest or sample.measured_ns >= newest[key].measured_ns:
            newest[key] = sample
    reads = [
        TagRead(to_time(s.measured_ns + utc_offset_ns), s.epc, s.antenna, min(counts[key], MAX_COUNT), s.rssi)
        for key, s in newest.items()
    ]
    return TagReads(header(scheduled_utc_ns, "rfid"), reads)


Build = Callable[[Any, int, int], Any | None]  # collected, UTC offset, scheduled time in UTC
BUILDERS: dict[str, tuple[Any, Build]] = {
    "laser/primary": (PRIMARY_SCAN, lambda collected, offset, _: laser_scan(collected, offset, "laser_primary")),
    "laser/auxiliary": (AUXILIARY_SCAN, lambda collected, offset, _: laser_scan(collected, offset, "laser_auxiliary")),
    "encoders": (JOINT_STATES, lambda collected, offset, _: joint_state(collected, offset)),
    "rfid": (TAGS, tag_reads),
}
