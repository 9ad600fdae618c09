"""What is in a tick is right: a drive with known motion through emulators, the server and zenoh, against the truth.

scan        the newest that had ended before the tick, stamped with its first ray
encoders    where the wheels were at the stamp, just before the tick
reads       all since the last tick, each once, each when it was read
age         of each sensor's newest sample, at the tick
"""

import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from rtlog_server.messages import OK, decode, to_ns
from rtlog_server.topics import BY_NAME

Drive = Any  # the fixture of conftest.py
TICKS = 40
PERIOD_NS = 100_000_000
SWEEP_NS = 15_000_000  # 270° at 50 Hz
USUAL = 0.7  # of the ticks, where a busy machine may hand over a sample late
TAGS = [f"E20034120000000000{k:06X}" for k in range(12)]


class Recorded:
    """The messages of some ticks in a row, with times on the monotonic clock."""

    def __init__(self, server: Any, drive: Drive) -> None:
        offset_ns = time.time_ns() - time.monotonic_ns()
        self.ticks = dict(messages(server, "rtlog/tick")[:TICKS])
        self.scheduled_ns = {tick: to_ns(message.scheduled) - offset_ns for tick, message in self.ticks.items()}
        self.scans = dict(messages(server, "laser/primary/scan"))
        joints = messages(server, "encoders/joint_states")
        self.joints = {tick: message for tick, message in joints if len(message.name) == len(drive.TURNS_PER_S)}
        self.tags = dict(messages(server, "rfid/tags"))
        self.first_rays_ns = np.array(drive.first_rays_ns)
        self.offset_ns = offset_ns

    def stamp_ns(self, message: Any) -> int:
        return to_ns(message.header.stamp) - self.offset_ns

    def age_s(self, tick: int, sensor: str) -> float:
        return next(state.age for state in self.ticks[tick].sensors if state.name == sensor)


def messages(server: Any, topic: str) -> list[tuple[int, Any]]:
    """By their ticks."""
    return [(s.attachment.tick, decode(s.payload, BY_NAME[f"/{topic}"].msgtype)) for s in server.on(topic)]


@pytest.fixture(scope="module")
def read_ns() -> dict[str, int]:
    """When which tag was read, by the reader's own clock that is the host's."""
    return {}


@pytest.fixture(scope="module")
def recorded(start_server: Callable[..., Any], drive: Drive, read_ns: dict[str, int]) -> Recorded:
    server = start_server(**drive.places)

    def well() -> bool:
        ticks = messages(server, "rtlog/tick")
        return bool(ticks) and {sensor.state for sensor in ticks[-1][1].sensors} == {OK}

    server.wait_until(well, timeout_s=20)
    server.wait_until(lambda: server.status()["devices"]["rfid"]["diagnostics"]["stream"] == "open", timeout_s=20)
    server.received.clear()
    server.wait_until(lambda: len(server.on("rtlog/tick")) >= 5)
    for k, epc in enumerate(TAGS):
        read_ns[epc] = time.monotonic_ns()
        drive.read_tag(epc)
        time.sleep(0.02 + 0.013 * (k % 5))  # anywhere between ticks, often more than one in a tick
    server.wait_until(lambda: len(server.on("rtlog/tick")) >= TICKS + 5, timeout_s=20)
    return Recorded(server, drive)


def test_the_ticks_are_whole(recorded: Recorded) -> None:
    first = min(recorded.ticks)
    assert list(recorded.ticks) == list(range(first, first + TICKS))
    assert len(recorded.scans.keys() & recorded.ticks.keys()) >= USUAL * TICKS


def test_a_tick_holds_the_newest_scan_that_had_ended(recorded: Recorded) -> None:
    newest = 0
    for tick in recorded.scans.keys() & recorded.ticks.keys():
        scan, tick_ns = recorded.scans[tick], recorded.scheduled_ns[tick]
        assert recorded.stamp_ns(scan) + (len(scan.ranges) - 1) * scan.time_increment * 1e9 <= tick_ns + 1e3
        k = round((float(scan.ranges[0]) - 1.0) * 1e3)  # the drive writes the scan's number into its ranges
        assert recorded.first_rays_ns[k] + SWEEP_NS < tick_ns
        assert recorded.stamp_ns(scan) == pytest.approx(recorded.first_rays_ns[k], abs=5e6)
        ended = np.flatnonzero(recorded.first_rays_ns + SWEEP_NS + 3_000_000 < tick_ns)  # and had come over the wire
        newest += k >= ended[-1]
        assert k >= ended[-1] - 5  # never older than a tick
    assert newest >= USUAL * TICKS


def test_no_scan_comes_twice(recorded: Recorded) -> None:
    stamps = [recorded.stamp_ns(recorded.scans[tick]) for tick in sorted(recorded.scans)]
    assert len(set(stamps)) == len(stamps)
    assert stamps == sorted(stamps)


def test_the_wheels_were_there_just_before_the_tick(recorded: Recorded, drive: Drive) -> None:
    ticks = sorted(recorded.joints.keys() & recorded.ticks.keys())
    assert len(ticks) >= USUAL * TICKS
    stamps_s = np.array([recorded.stamp_ns(recorded.joints[tick]) for tick in ticks]) * 1e-9
    ages_s = np.array([recorded.scheduled_ns[tick] for tick in ticks]) * 1e-9 - stamps_s
    assert (ages_s > 0).all()
    assert np.median(ages_s) < 0.03
    positions = np.array([recorded.joints[tick].position for tick in ticks])
    for column, turns_per_s in enumerate(drive.TURNS_PER_S.values()):
        late_s = (positions[:, column] / (2 * math.pi) - turns_per_s * stamps_s) / turns_per_s
        turn_s = 1 / abs(turns_per_s)
        late_s -= turn_s * round(float(late_s[0]) / turn_s)  # the count starts within one turn
        # they were latched up to a look apart (4 ms), and a count is 0.3 to 0.8 ms
        assert np.median(np.abs(late_s)) < 6e-3
        assert np.abs(late_s).max() < 30e-3


def test_ages_are_those_of_the_stamps(recorded: Recorded) -> None:
    compared = 0
    for sensor, found in (("laser/primary", recorded.scans), ("encoders", recorded.joints)):
        for tick in found.keys() & recorded.ticks.keys():
            stamp_ns = to_ns(found[tick].header.stamp)
            age_s = (to_ns(recorded.ticks[tick].scheduled) - stamp_ns) * 1e-9
            assert recorded.age_s(tick, sensor) == pytest.approx(age_s, abs=1e-6)
            compared += 1
    assert compared >= 2 * USUAL * TICKS


def test_each_read_comes_once_in_the_first_tick_after_it(recorded: Recorded, read_ns: dict[str, int]) -> None:
    usual = 0
    told: list[str] = []
    for tick in recorded.tags.keys() & recorded.ticks.keys():
        for read in recorded.tags[tick].reads:
            told += [read.epc] * read.count
            stamp_ns, tick_ns = to_ns(read.stamp) - recorded.offset_ns, recorded.scheduled_ns[tick]
            assert stamp_ns <= tick_ns
            assert stamp_ns == pytest.approx(read_ns[read.epc], abs=60e6)
            usual += tick_ns - PERIOD_NS < read_ns[read.epc] + 5_000_000 <= tick_ns + 5_000_000
    assert sorted(told) == TAGS
    assert usual >= USUAL * len(TAGS)
