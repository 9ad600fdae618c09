"""At a tick: devices whose threads run, samples handed over by hand, the messages as bytes of the contract."""

import math
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from patience import wait_until

from rtlog_server.bundle import Sample
from rtlog_server.devices.device import Device, DeviceError, TickGrid
from rtlog_server.devices.encoders import EncoderReading
from rtlog_server.devices.laser import Scan
from rtlog_server.devices.rfid import TagSample
from rtlog_server.messages import MISSING, OK, STALE, decode, to_ns
from rtlog_server.sampler import Sampler
from rtlog_server.ticker import TickTime
from rtlog_server.topics import BY_NAME

MS = 1_000_000
PERIOD_NS = 100 * MS
UTC_OFFSET_NS = 1_700_000_000_123_456_789
EPC = "E2003411B802011526370494"


class HandFed(Device[Any]):
    """A device that is there or away as the test wants, and measures what the test hands over."""

    def __init__(self, name: str) -> None:
        super().__init__(name, stale_after_s=0.25)
        self.there = True

    def connect(self) -> None:
        if not self.there:
            raise DeviceError(f"{self.name}: away")
        self.identity = {"serial_number": "4711"}

    def read(self) -> None:
        if not self.there:
            raise DeviceError(f"{self.name}: away")
        self.pause(0.002)

    def disconnect(self) -> None:
        pass

    def go(self, there: bool) -> None:
        """Come or go away, and wait until the frame has noticed."""
        self.there = there
        wait_until(lambda: self.connected == there)


class Bench:
    """Three devices, a sampler, and a clock that the test moves from tick to tick."""

    def __init__(self) -> None:
        self.laser, self.encoders, self.rfid = HandFed("laser/primary"), HandFed("encoders"), HandFed("rfid")
        self.devices = [self.laser, self.encoders, self.rfid]
        grid = TickGrid(time.monotonic_ns(), PERIOD_NS)
        for device in self.devices:
            device.start(grid)
            device.go(there=True)
        for device in self.devices:
            device.heard()
        self.start_ns = time.monotonic_ns()
        self.sampler = Sampler(self.devices, UTC_OFFSET_NS)

    def at(self, index: int) -> int:
        """When tick `index` is."""
        return self.start_ns + index * PERIOD_NS

    def tick(self, index: int, late_ns: int = 0) -> tuple[Any, dict[str, Any], list[Sample]]:
        """The Tick message, the others by topic, and the samples as they are."""
        samples, _ = self.sampler.sample(TickTime(index, self.at(index), self.at(index) + late_ns))
        messages = [decode(sample.data, BY_NAME[sample.topic].msgtype) for sample in samples]
        assert samples[0].topic == "/rtlog/tick"
        return messages[0], {s.topic: m for s, m in zip(samples[1:], messages[1:], strict=True)}, samples


@pytest.fixture
def bench() -> Iterator[Bench]:
    bench = Bench()
    yield bench
    for device in bench.devices:
        device.close()


def scan(first_ray_ns: int, range_m: float = 3.0) -> Scan:
    return Scan(
        measured_ns=first_ray_ns,
        complete_ns=first_ray_ns + 15 * MS,
        ranges_m=np.array([range_m, math.inf, math.nan], np.float32),
        intensities=np.array([120, 0, 3], np.float32),
        angle_min_rad=-0.5,
        angle_increment_rad=0.25,
        time_increment_s=2.5e-5,
        scan_time_s=0.02,
        range_min_m=0.01,
        range_max_m=20.0,
        telegram_counter=1,
        scan_counter=1,
        device_status=0,
    )


def tag(received_ns: int, count: int = 1, antenna: int = 0, epc: str = EPC, rssi: float = -50.0) -> TagSample:
    return TagSample(received_ns, received_ns, epc, antenna, count, rssi, None)


def states(tick: Any) -> list[int]:
    return [sensor.state for sensor in tick.sensors]


def test_the_newest_scan_goes_out_stamped_with_its_first_ray(bench: Bench) -> None:
    for k in range(5):
        bench.laser.hand_over(scan(bench.at(0) - 100 * MS + 20 * k * MS, range_m=k))
    tick, messages, _ = bench.tick(0)
    message = messages["/laser/primary/scan"]
    assert to_ns(message.header.stamp) == bench.at(0) - 20 * MS + UTC_OFFSET_NS
    assert message.header.frame_id == "laser_primary"
    np.testing.assert_array_equal(message.ranges, np.array([4.0, np.inf, np.nan], np.float32))
    np.testing.assert_array_equal(message.intensities, np.array([120, 0, 3], np.float32))
    angles = (message.angle_min, message.angle_max, message.angle_increment)
    np.testing.assert_allclose(angles, (-0.5, 0.0, 0.25))
    times = (message.time_increment, message.scan_time, message.range_min, message.range_max)
    np.testing.assert_allclose(times, (2.5e-5, 0.02, 0.01, 20.0), rtol=1e-6)
    assert tick.sensors[0].name == "laser/primary"
    assert tick.sensors[0].age == pytest.approx(0.02)


def test_a_scan_that_is_complete_after_the_tick_belongs_to_the_next(bench: Bench) -> None:
    bench.laser.hand_over(scan(bench.at(0) - 10 * MS))
    assert "/laser/primary/scan" not in bench.tick(0, late_ns=50 * MS)[1]
    _, messages, samples = bench.tick(1)
    assert to_ns(messages["/laser/primary/scan"].header.stamp) == bench.at(0) - 10 * MS + UTC_OFFSET_NS
    assert [sample.sequence for sample in samples if "scan" in sample.topic] == [0]
    assert "/laser/primary/scan" not in bench.tick(2)[1]


def test_the_newest_reading_goes_out_stamped_with_its_latch(bench: Bench) -> None:
    for k in range(2):
        latched_ns = bench.at(k) - 8 * MS
        names = ("left_wheel", "right_wheel")
        reading = EncoderReading(latched_ns, latched_ns + 4 * MS, names, (0, 0), (12.5 + k, -700.25), ())
        bench.encoders.hand_over(reading)
    assert bench.tick(0)[1]["/encoders/joint_states"].position[0] == 12.5
    message = bench.tick(1)[1]["/encoders/joint_states"]
    assert to_ns(message.header.stamp) == bench.at(1) - 8 * MS + UTC_OFFSET_NS
    assert message.name == ["left_wheel", "right_wheel"]
    assert message.position.tolist() == [13.5, -700.25]
    assert len(message.velocity) == len(message.effort) == 0


def test_reads_of_a_tick_are_added_up_by_tag_and_antenna(bench: Bench) -> None:
    before_ns = bench.at(0) - 90 * MS
    bench.rfid.hand_over(tag(before_ns, count=3, rssi=-50.0))
    bench.rfid.hand_over(tag(before_ns + MS, antenna=1))
    bench.rfid.hand_over(tag(before_ns + 2 * MS, count=4, rssi=-40.0))
    bench.rfid.hand_over(tag(before_ns + 3 * MS, epc="AB", count=65_000, rssi=math.nan))
    bench.rfid.hand_over(tag(before_ns + 4 * MS, epc="AB", count=65_000, rssi=math.nan))
    bench.rfid.hand_over(tag(bench.at(0) + MS, epc="CD"))
    message = bench.tick(0)[1]["/rfid/tags"]
    reads = {(read.epc, read.antenna): read for read in message.reads}
    assert {key: read.count for key, read in reads.items()} == {(EPC, 0): 7, (EPC, 1): 1, ("AB", 0): 65535}
    assert to_ns(reads[EPC, 0].stamp) == before_ns + 2 * MS + UTC_OFFSET_NS
    assert reads[EPC, 0].rssi == -40.0
    assert math.isnan(reads["AB", 0].rssi)
    assert to_ns(message.header.stamp) == bench.at(0) + UTC_OFFSET_NS
    assert [read.epc for read in bench.tick(1)[1]["/rfid/tags"].reads] == ["CD"]


def test_a_reader_without_tags_sends_none_and_one_that_is_away_is_silent(bench: Bench) -> None:
    assert bench.tick(0)[1]["/rfid/tags"].reads == []
    tick, messages, _ = bench.tick(20)  # two seconds later, nothing heard since
    assert states(tick)[2] == STALE
    assert messages["/rfid/tags"].reads == []
    bench.rfid.hand_over(tag(bench.at(20) + MS))
    bench.rfid.go(there=False)
    tick, messages, _ = bench.tick(21)
    assert states(tick)[2] == MISSING
    assert len(messages["/rfid/tags"].reads) == 1  # what it read before it went
    assert "/rfid/tags" not in bench.tick(22)[1]
    bench.rfid.go(there=True)
    assert "/rfid/tags" in bench.tick(23)[1]


def test_tick_tells_time_lateness_and_states(bench: Bench) -> None:
    bench.laser.go(there=False)
    bench.encoders.hand_over(EncoderReading(bench.at(0) - 6 * MS, bench.at(0) - 2 * MS, ("a",), (0,), (0.0,), ()))
    tick, _, _ = bench.tick(0, late_ns=3 * MS)
    assert to_ns(tick.scheduled) == bench.at(0) + UTC_OFFSET_NS
    assert to_ns(tick.header.stamp) == bench.at(0) + 3 * MS + UTC_OFFSET_NS
    assert tick.lateness == pytest.approx(0.003)
    assert [sensor.name for sensor in tick.sensors] == ["laser/primary", "encoders", "rfid"]
    assert states(tick) == [MISSING, OK, OK]
    assert [sensor.age for sensor in tick.sensors] == [math.inf, pytest.approx(0.006), math.inf]


def test_ticks_made_up_for_get_the_samples_of_their_own_time(bench: Bench) -> None:
    """The tick loop stood still over ticks 0 to 2 while its drivers went on."""
    for k in range(3):
        bench.laser.hand_over(scan(bench.at(k) - 20 * MS, range_m=k))
    for k in range(3):
        tick, messages, samples = bench.tick(k, late_ns=(3 - k) * PERIOD_NS)
        assert messages["/laser/primary/scan"].ranges[0] == k
        assert tick.lateness == pytest.approx((3 - k) * 0.1)
        assert samples[0].sequence == tick.index == k


def test_sequences_count_what_was_sent_by_topic(bench: Bench) -> None:
    numbers = []
    for k in range(4):
        if k != 1:
            bench.laser.hand_over(scan(bench.at(k) - 20 * MS))
        numbers.append({sample.topic: sample.sequence for sample in bench.tick(k)[2]})
    assert [n["/rtlog/tick"] for n in numbers] == [0, 1, 2, 3]
    assert [n.get("/laser/primary/scan") for n in numbers] == [0, None, 1, 2]


def test_reports_say_how_the_devices_are(bench: Bench) -> None:
    bench.laser.go(there=False)
    _, reports = bench.sampler.sample(TickTime(0, bench.at(0), bench.at(0)))
    assert [report.state for report in reports] == [MISSING, OK, OK]
    assert [report.message for report in reports] == ["laser/primary: away", "connected", "connected"]
    assert reports[1].identity == {"serial_number": "4711"}
    assert reports[1].connects == 1
