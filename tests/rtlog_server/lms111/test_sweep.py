"""What a scanner says of a sweep, in metres, the scanner's frame and host time."""

import math
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from rtlog_server.devices.lms111.cola import ColaError, Dialect, Receiver
from rtlog_server.devices.lms111.protocol import decode
from rtlog_server.devices.lms111.scan_data import Channel, ScanData
from rtlog_server.devices.lms111.sweep import first_ray_delay_us, period_us, sweep_us, to_scan

CAPTURES = Path(__file__).parents[4] / "shared" / "data" / "lms111"
needs_captures = pytest.mark.skipif(not CAPTURES.is_dir(), reason=f"no captured sessions in {CAPTURES}")
TRANSMITTED_NS = 1_000_000_000_000


def distances(raw: list[int], start_1e4deg: int = -450_000, step_1e4deg: int = 5000, scale: float = 1.0) -> Channel:
    return Channel("DIST1", scale, 0.0, start_1e4deg, step_1e4deg, np.array(raw, np.uint16))


def scan_of(*channels: Channel, startup_us: int = 0, transmission_us: int = 23_000) -> ScanData:
    return ScanData(
        1, 1, 1, (0, 0), 1, 1, startup_us, transmission_us, (0, 0), (0, 0), 0, 5000, 360, (), tuple(channels), ()
    )


def captured(file: str, dialect: Dialect) -> list[ScanData]:
    telegrams = (decode(dialect, payload) for payload in Receiver(dialect).feed((CAPTURES / file).read_bytes()))
    return [telegram for telegram in telegrams if isinstance(telegram, ScanData)]


def test_ranges_follow_rep_117() -> None:
    scan = to_scan(scan_of(distances([0, 1, 3, 15, 16, 62, 20000])), TRANSMITTED_NS, 20_000)
    expected = [math.inf, math.nan, math.nan, math.nan, 0.016, 0.062, 20.0]
    np.testing.assert_allclose(scan.ranges_m, np.array(expected, np.float32), rtol=0)
    assert scan.ranges_m.dtype == np.float32
    assert scan.range_min_m <= 0.016
    assert scan.range_max_m == 20.0


def test_scale_and_offset() -> None:
    channel = replace(distances([0, 100, 7]), scale_factor=2.0, scale_offset=30.0)
    assert to_scan(scan_of(channel), TRANSMITTED_NS, 20_000).ranges_m.tolist() == pytest.approx(
        [math.inf, 0.23, math.nan], nan_ok=True
    )


def test_angles_are_the_scanner_frames() -> None:
    scan = to_scan(scan_of(distances(541 * [1000])), TRANSMITTED_NS, 20_000)
    angles = scan.angle_min_rad + scan.angle_increment_rad * np.arange(541)
    assert math.degrees(angles[0]) == pytest.approx(-135)
    assert math.degrees(angles[270]) == pytest.approx(0)  # 90° of the device: straight ahead
    assert math.degrees(angles[-1]) == pytest.approx(135)


def test_remission_of_either_width() -> None:
    rssi16 = Channel("RSSI1", 1.0, 0.0, 0, 5000, np.array([5, 65535], np.uint16))
    scan = to_scan(scan_of(distances([100, 200]), rssi16), TRANSMITTED_NS, 20_000)
    assert scan.intensities.tolist() == [5, 65535]
    rssi8 = Channel("RSSI1", 1.0, 0.0, 0, 5000, np.array([5, 255], np.uint8))
    scan = to_scan(replace(scan_of(distances([100, 200])), channels8=(rssi8,)), TRANSMITTED_NS, 20_000)
    assert scan.intensities.tolist() == [5, 255]
    assert scan.intensities.dtype == np.float32
    assert to_scan(scan_of(distances([100, 200])), TRANSMITTED_NS, 20_000).intensities.shape == (0,)


def test_times_of_a_stamp_before_the_sweep() -> None:
    scan = to_scan(scan_of(distances(541 * [1000])), TRANSMITTED_NS, 20_000)
    assert TRANSMITTED_NS - scan.measured_ns == 23_000_000
    assert scan.complete_ns - scan.measured_ns == 15_000_000  # 270° of 360° in 20 ms
    assert scan.time_increment_s == pytest.approx(0.02 * 0.5 / 360)
    assert scan.scan_time_s == pytest.approx(0.02)


def test_a_later_sector_is_measured_later() -> None:
    scan = to_scan(scan_of(distances(361 * [1000], start_1e4deg=0)), TRANSMITTED_NS, 20_000)
    assert TRANSMITTED_NS - scan.measured_ns == 23_000_000 - 2_500_000  # 45° after the zero index
    assert scan.complete_ns - scan.measured_ns == 10_000_000


def test_a_stamp_after_the_sweep_belongs_to_the_turns_end() -> None:
    scan = to_scan(scan_of(distances(541 * [1000]), transmission_us=3_100), TRANSMITTED_NS, 20_000)
    assert TRANSMITTED_NS - scan.measured_ns == 23_100_000


def test_times_across_a_wrap_of_the_count() -> None:
    wrapped = scan_of(distances(541 * [1000]), startup_us=2**32 - 10_000, transmission_us=13_000)
    assert TRANSMITTED_NS - to_scan(wrapped, TRANSMITTED_NS, 20_000).measured_ns == 23_000_000


def test_period() -> None:
    before = scan_of(distances([100]), startup_us=2**32 - 5_000)
    after = replace(before, scan_counter=2, time_since_startup_us=15_114)
    assert period_us(after, before) == 20_114
    assert period_us(after, None) == 20_000
    assert period_us(replace(after, scan_counter=3), before) == 20_000  # not its neighbour
    assert period_us(replace(after, time_since_startup_us=16_000), before) == 20_000  # no motor is 5 % slow
    assert period_us(replace(before, scan_counter=0), replace(before, scan_counter=65535)) == 20_000
    with pytest.raises(ColaError, match="frequency"):
        period_us(replace(after, scan_frequency_centihz=0), before)


def test_no_distances_is_no_scan() -> None:
    for channels in ((), (distances([]),), (replace(distances([100]), content="RSSI1"),)):
        with pytest.raises(ColaError, match="DIST1"):
            to_scan(scan_of(*channels), TRANSMITTED_NS, 20_000)


def test_sweep_geometry() -> None:
    assert first_ray_delay_us(-450_000, 20_000) == 0
    assert first_ray_delay_us(900_000, 20_000) == 7_500
    assert sweep_us(541, 5000, 20_000) == 15_000
    assert sweep_us(0, 5000, 20_000) == 0


@needs_captures
def test_captured_scans_are_complete_before_they_are_sent() -> None:
    scans = [*captured("colab_dev2host.bin", Dialect.B), *captured("lms_cola_a_scan541_cont.bin", Dialect.A)]
    for data in scans:
        scan = to_scan(data, TRANSMITTED_NS, 20_000)
        assert 7e6 < TRANSMITTED_NS - scan.complete_ns < 9e6  # both firmwares, whichever index they stamp
        assert len(scan.ranges_m) == 541


@needs_captures
def test_the_captured_motor_is_timed() -> None:
    scans = captured("colab_dev2host.bin", Dialect.B)
    periods = [period_us(b, a) for a, b in pairwise(scans) if a.scan_counter != b.scan_counter]
    assert np.mean(periods) == pytest.approx(20_130, abs=30)
    assert min(periods) > 19_800
