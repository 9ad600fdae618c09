"""What a scanner says of a sweep, in metres, the scanner's frame and host time."""

import math
from contextlib import suppress
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

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


def test_what_lies_behind_the_scanner_is_no_range() -> None:
    channel = replace(distances([0, 16, 100, 101]), scale_offset=-100.0)
    assert to_scan(scan_of(channel), TRANSMITTED_NS, 20_000).ranges_m.tolist() == pytest.approx(
        [math.inf, math.nan, math.nan, 0.001], nan_ok=True
    )


@pytest.mark.parametrize(
    ("echo", "ranges", "remission"),
    [("first", [1.0, math.inf, 3.0, math.nan], [1, 2, 3, 4]), ("last", [5.0, 6.0, 3.0, math.nan], [50, 60, 3, 4])],
)
def test_the_first_or_the_last_echo(echo: str, ranges: list[float], remission: list[float]) -> None:
    first, second = distances([1000, 0, 3000, 1]), replace(distances([5000, 6000, 0, 3]), content="DIST2")
    rssi = [
        Channel(f"RSSI{k}", 1.0, 0.0, 0, 5000, np.array(data, np.uint8))
        for k, data in ((1, [1, 2, 3, 4]), (2, [50, 60, 0, 0]))
    ]
    scan = to_scan(replace(scan_of(first, second), channels8=tuple(rssi)), TRANSMITTED_NS, 20_000, echo)
    np.testing.assert_array_equal(scan.ranges_m, np.array(ranges, np.float32))
    assert scan.intensities.tolist() == remission
    assert scan.ranges_m.dtype == scan.intensities.dtype == np.float32


def test_second_echoes_without_remission_keep_the_first_ones() -> None:
    first, second = distances([1000, 2000]), replace(distances([0, 6000]), content="DIST2")
    rssi = Channel("RSSI1", 1.0, 0.0, 0, 5000, np.array([7, 8], np.uint16))
    assert to_scan(scan_of(first, second, rssi), TRANSMITTED_NS, 20_000, "last").intensities.tolist() == [7, 8]


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
    for impossible in (0, 499, 10_001, 2**32 - 1):
        with pytest.raises(ColaError, match="frequency"):
            period_us(replace(after, scan_frequency_centihz=impossible), before)


def test_no_distances_is_no_scan() -> None:
    for channels in ((), (distances([]),), (replace(distances([100]), content="RSSI1"),)):
        with pytest.raises(ColaError, match="DIST1"):
            to_scan(scan_of(*channels), TRANSMITTED_NS, 20_000)


def test_as_many_second_echoes_as_first_ones() -> None:
    with pytest.raises(ColaError, match="2 first and 1 second"):
        to_scan(scan_of(distances([1, 2]), replace(distances([1]), content="DIST2")), TRANSMITTED_NS, 20_000, "last")


@pytest.mark.parametrize(
    ("scan", "message"),
    [
        (scan_of(distances(721 * [1000], start_1e4deg=0, step_1e4deg=5001)), "721 rays"),
        (scan_of(distances([1000], step_1e4deg=0)), "steps of 0°"),
        (scan_of(distances([1000], start_1e4deg=-3_600_001)), "from -360"),
        (scan_of(distances([1000]), startup_us=0, transmission_us=5_000_001), "5.0 s after its sweep"),
        (scan_of(distances([1000]), startup_us=1, transmission_us=0), "4295.0 s after its sweep"),
    ],
)
def test_what_no_scanner_can_make_is_refused(scan: ScanData, message: str) -> None:
    with pytest.raises(ColaError, match=message):
        to_scan(scan, TRANSMITTED_NS, 20_000)


@given(
    raw=st.lists(st.integers(0, 65535), min_size=1, max_size=30),
    start=st.integers(-(2**31), 2**31 - 1) | st.integers(-4_000_000, 4_000_000),
    step=st.integers(0, 65535),
    scale=st.floats(1e-6, 1e6),
    offset=st.floats(-1e6, 1e6),
    frequency=st.integers(0, 2**32 - 1) | st.integers(0, 20_000),
    age_us=st.integers(0, 2**32 - 1) | st.integers(0, 100_000),
)
def test_no_scan_is_complete_before_it_came_or_long_before(
    raw: list[int], start: int, step: int, scale: float, offset: float, frequency: int, age_us: int
) -> None:
    channel = replace(distances(raw, start, step, scale), scale_offset=offset)
    data = replace(scan_of(channel, transmission_us=age_us), scan_frequency_centihz=frequency)
    with suppress(ColaError):
        scan = to_scan(data, TRANSMITTED_NS, period_us(data, None))
        assert scan.measured_ns <= scan.complete_ns <= TRANSMITTED_NS
        assert TRANSMITTED_NS - scan.measured_ns < 6e9
        assert not (scan.ranges_m <= 0).any()
        assert 0.009 < scan.scan_time_s < 0.21


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
