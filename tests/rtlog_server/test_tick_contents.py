"""What is in a tick is right: a drive with known motion through emulators, the server and zenoh, against the truth.

scan        one that had ended before the tick, newer than the last one's, stamped with its first ray
encoders    where the wheels were between the stamp and the tick
reads       all since the last tick, each once, each when it was read
age         of each sensor's newest sample, at the tick
"""

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from rtlog_server.messages import OK, decode, to_ns
from rtlog_server.ticker import utc_offset_ns
from rtlog_server.topics import BY_NAME

Drive = Any  # the fixture of conftest.py
SAMPLES = 25  # of each device, at the least
SWEEP_NS = 15_000_000  # 270° at 50 Hz
CLOCKS_NS = 1_000_000  # by which wall clock and monotonic clock may part while a server runs
CUT_NS = 2_000_000  # the reader tells whole milliseconds
SHIFT_NS = 50_000_000  # over which a speed brings positions of one round to one stamp, and its own error
TAGS = [f"E20034120000000000{k:06X}" for k in range(12)]


class Recorded:
    """The messages of some ticks in a row, with times on the monotonic clock."""

    def __init__(self, server: Any, drive: Drive) -> None:
        self.offset_ns = utc_offset_ns()
        self.ticks = dict(messages(server, "rtlog/tick"))
        self.scheduled_ns = {tick: to_ns(message.scheduled) - self.offset_ns for tick, message in self.ticks.items()}
        self.scans = self._of(server, "laser/primary/scan")
        self.joints = self._of(server, "encoders/joint_states")
        self.tags = self._of(server, "rfid/tags")
        self.first_rays_ns = list(drive.first_rays_ns)

    def _of(self, server: Any, topic: str) -> dict[int, Any]:
        return {tick: message for tick, message in messages(server, topic) if tick in self.ticks}

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

    server.wait_until(well)
    server.wait_until(lambda: server.status()["devices"]["rfid"]["diagnostics"]["stream"] == "open")
    server.received.clear()
    server.wait_until(lambda: len(server.on("rtlog/tick")) >= 5)
    for k, epc in enumerate(TAGS):
        read_ns[epc] = time.monotonic_ns()
        drive.read_tag(epc)
        time.sleep(0.02 + 0.013 * (k % 5))  # anywhere between ticks, often more than one in a tick
    for topic in ("laser/primary/scan", "encoders/joint_states"):  # on a busy machine some ticks go without
        server.wait_until(lambda: len(server.on(topic)) >= SAMPLES)  # noqa: B023
    server.wait_until(lambda: sum(len(message.reads) for _, message in messages(server, "rfid/tags")) >= len(TAGS))
    newest = max(sample.attachment.tick for sample in server.received if sample.attachment is not None)
    server.wait_until(lambda: server.on("rtlog/tick")[-1].attachment.tick > newest)
    return Recorded(server, drive)


def test_the_ticks_are_whole(recorded: Recorded) -> None:
    first = min(recorded.ticks)
    assert list(recorded.ticks) == list(range(first, first + len(recorded.ticks)))


def test_a_tick_holds_a_scan_that_had_ended_and_never_an_older_one(recorded: Recorded) -> None:
    numbers, late_ns = [], []
    for tick in sorted(recorded.scans):
        scan, tick_ns = recorded.scans[tick], recorded.scheduled_ns[tick]
        assert recorded.stamp_ns(scan) + (len(scan.ranges) - 1) * scan.time_increment * 1e9 <= tick_ns + CLOCKS_NS
        numbers.append(round((float(scan.ranges[0]) - 1.0) * 1e3))  # the drive writes it into the ranges
        late_ns.append(recorded.stamp_ns(scan) - recorded.first_rays_ns[numbers[-1]])
        assert recorded.first_rays_ns[numbers[-1]] + SWEEP_NS < tick_ns + CLOCKS_NS
    assert numbers == sorted(numbers)
    assert min(late_ns) > -CLOCKS_NS
    assert np.diff(late_ns).max() < CLOCKS_NS  # it is the fastest delivery so far, and no late one makes it grow


def test_no_scan_comes_twice(recorded: Recorded) -> None:
    stamps = [recorded.stamp_ns(recorded.scans[tick]) for tick in sorted(recorded.scans)]
    assert len(set(stamps)) == len(stamps)
    assert stamps == sorted(stamps)


def test_the_wheels_were_there_between_the_stamp_and_the_tick(recorded: Recorded, drive: Drive) -> None:
    whole = {tick: message for tick, message in recorded.joints.items() if len(message.name) == len(drive.TURNS_PER_S)}
    assert whole
    for tick, message in whole.items():
        stamp_ns = recorded.stamp_ns(message)
        late_ns = drive.late_ns(message.position, stamp_ns)
        assert stamp_ns < recorded.scheduled_ns[tick]
        assert late_ns.min() > -SHIFT_NS
        assert stamp_ns + late_ns.max() < recorded.scheduled_ns[tick] + SHIFT_NS


def test_ages_are_those_of_the_stamps(recorded: Recorded) -> None:
    compared = 0
    for sensor, found in (("laser/primary", recorded.scans), ("encoders", recorded.joints)):
        for tick in found:
            stamp_ns = to_ns(found[tick].header.stamp)
            age_s = (to_ns(recorded.ticks[tick].scheduled) - stamp_ns) * 1e-9
            assert recorded.age_s(tick, sensor) == pytest.approx(age_s, abs=1e-6)
            compared += 1
    assert compared >= 2 * SAMPLES


def test_each_read_comes_once_in_a_tick_after_it(recorded: Recorded, read_ns: dict[str, int]) -> None:
    told: list[str] = []
    for tick in sorted(recorded.tags):
        for read in recorded.tags[tick].reads:
            told += [read.epc] * read.count
            stamp_ns = to_ns(read.stamp) - recorded.offset_ns
            assert read_ns[read.epc] - CUT_NS < stamp_ns <= recorded.scheduled_ns[tick] + CLOCKS_NS
    assert told == TAGS
