"""The driver against an emulated scanner, on real sockets: what comes out is what was measured."""

import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from patience import PATIENCE_S, wait_until

from rtlog_server.devices.lms111.emulator import Lms111Emulator
from rtlog_server.messages import MISSING, OK

Open = Feed = Callable[..., Any]


@pytest.mark.parametrize("dialect", ["A", "B"])
def test_scans_arrive_as_they_were_measured(dialect: str, open_drive: Open, feed: Feed) -> None:
    """Across a wrap of the device's count of microseconds and of its counters."""
    clock = {"clock_offset_us": 2**32 - 500_000, "clock_drift_ppm": 50}
    emulator = Lms111Emulator(dialect=dialect, serial_no=14090017, telegrams=65_520, **clock)
    drive = open_drive(emulator.address)
    assert emulator.wait_streaming(PATIENCE_S)
    feeder = feed(emulator)
    scans = drive.wait_scans(40)
    assert [feeder.index(scan) for scan in scans] == list(range(len(scans)))
    for scan in scans:
        np.testing.assert_allclose(scan.ranges_m, feeder.ranges_m(feeder.index(scan)), atol=1e-6)
        assert scan.intensities.tolist() == list(range(0, 5410, 10))
        assert scan.angle_min_rad == pytest.approx(math.radians(-135), abs=1e-6)
        assert scan.angle_increment_rad == pytest.approx(math.radians(0.5), abs=1e-6)
        assert scan.complete_ns - scan.measured_ns == pytest.approx(15e6, rel=0.03)
    feeder.assert_true_stamps(scans, drive.arrived_ns[: len(scans)])
    assert drive.driver.identity == {"model": "LMS111", "firmware": "V1.80.2", "serial_number": "14090017"}
    assert drive.driver.diagnostics["dialect"] == f"CoLa {dialect}"
    assert drive.driver.diagnostics["temperature"] == "ok"
    assert [scan.telegram_counter for scan in scans] == [(65_521 + k) % 65_536 for k in range(len(scans))]
    assert drive.driver.diagnostics["scans lost"] == "0"
    assert drive.driver.diagnostics["garbage [bytes]"] == "0"
    assert drive.driver.message == "connected"
    drive.wait_state(OK)


@pytest.mark.parametrize(("rays", "start_deg"), [(361, -90.0), (3, 0.0), (720, -180.0)])
def test_any_sector(rays: int, start_deg: float, open_drive: Open, feed: Feed) -> None:
    emulator = Lms111Emulator()
    drive = open_drive(emulator.address)
    feeder = feed(emulator, rays=rays, start_deg=start_deg)
    scans = drive.wait_scans(20)
    assert {len(scan.ranges_m) for scan in scans} == {rays}
    assert scans[0].angle_min_rad == pytest.approx(math.radians(start_deg), abs=1e-6)
    feeder.assert_true_stamps(scans, drive.arrived_ns[: len(scans)])


@pytest.mark.parametrize("dialect", ["A", "B"])
def test_25_hz(dialect: str, open_drive: Open, feed: Feed) -> None:
    emulator = Lms111Emulator(dialect=dialect)
    drive = open_drive(emulator.address, scan_frequency_hz=25)
    feeder = feed(emulator, rays=1081, step_deg=0.25, period_s=0.04)
    scans = drive.wait_scans(10)
    for scan in scans:
        np.testing.assert_allclose(scan.ranges_m, feeder.ranges_m(feeder.index(scan)), atol=1e-6)
        assert scan.scan_time_s == pytest.approx(0.04, rel=1e-3)
        assert scan.angle_increment_rad == pytest.approx(math.radians(0.25), abs=1e-6)
    feeder.assert_true_stamps(scans, drive.arrived_ns[: len(scans)])


def two_echoes(_: int) -> tuple[np.ndarray, np.ndarray]:
    """Every third ray meets a second thing, at 9 m, that reflects 7; the last of them is rejected."""
    ranges, remission = np.full(541, np.inf), np.zeros(541)
    ranges[::3], remission[::3] = 9.0, 7.0
    ranges[540] = np.nan
    return ranges, remission


@pytest.mark.parametrize("dialect", ["A", "B"])
@pytest.mark.parametrize("bits", [8, 16])
def test_the_first_or_the_last_echo(dialect: str, bits: int, open_drive: Open, feed: Feed) -> None:
    emulator = Lms111Emulator(dialect=dialect)
    scans = {}
    for echo in ("first", "last"):
        drive = open_drive(emulator.address, echo=echo, remission_bits=bits)
        assert emulator.wait_streaming(PATIENCE_S)
        feeder = feed(emulator, second_echo=two_echoes)
        scans[echo] = drive.wait_scans(2)[-1]
        feeder.stop()
        expected = feeder.ranges_m(feeder.index(scans[echo]))
        drive.driver.close()
        if echo == "last":
            expected[0:540:3] = 9.0
        np.testing.assert_allclose(scans[echo].ranges_m, expected, atol=1e-6)
    remission = np.minimum(np.arange(541) * 10.0, 2**bits - 1)
    np.testing.assert_array_equal(scans["first"].intensities, remission)
    remission[0:540:3] = 7.0
    np.testing.assert_array_equal(scans["last"].intensities, remission)


def test_a_scanner_without_second_echoes_may_be_asked_for_the_last(open_drive: Open, feed: Feed) -> None:
    emulator = Lms111Emulator()
    drive = open_drive(emulator.address, echo="last")
    feeder = feed(emulator)
    scan = drive.wait_scans(1)[0]
    np.testing.assert_allclose(scan.ranges_m, feeder.ranges_m(feeder.index(scan)), atol=1e-6)


def test_the_stamps_are_true_though_the_network_jitters(open_drive: Open, feed: Feed) -> None:
    """Exponential delays of 1 ms, and one of 15 ms in ten; the clock drifts by 80 ppm and wraps on the way.

    How true they are in milliseconds, with the slope of the drift and restarts, is measured in the long tests.
    """
    emulator = Lms111Emulator(clock_offset_us=2**32 - 1_500_000, clock_drift_ppm=80)
    delays = np.random.default_rng(1)
    emulator.set_delivery(lambda: int(delays.exponential(1e6) + 15e6 * (delays.random() < 0.1)))
    drive = open_drive(emulator.address)
    assert emulator.wait_streaming(PATIENCE_S)
    feeder = feed(emulator)
    scans = drive.wait_scans(120)
    assert drive.driver.diagnostics["scans lost"] == "0"
    feeder.assert_true_stamps(scans, drive.arrived_ns[: len(scans)])


# How it is


def test_a_scanner_that_takes_its_time_is_waited_for(open_drive: Open, feed: Feed) -> None:
    emulator = Lms111Emulator(start_s=0.6)
    drive = open_drive(emulator.address)
    feed(emulator)
    drive.wait_message("in preparation")
    assert drive.state == MISSING
    drive.wait_scans(3)


def test_a_scanner_in_the_cold_says_so_and_measures(open_drive: Open, feed: Feed) -> None:
    emulator = Lms111Emulator()
    emulator.set_temperature(outside=True)
    drive = open_drive(emulator.address)
    feed(emulator)
    drive.wait_scans(3)
    assert drive.driver.diagnostics["temperature"] == "outside of its range"


@pytest.mark.parametrize(
    ("status", "message"),
    [
        (1, "device error"),
        (2, "front window is dirty"),
        (4, "front window is too dirty"),
        (5, "front window is too dirty"),
        (9, "device status 9"),
    ],
)
def test_what_a_scanner_says_of_itself_is_told_and_its_scans_go_on(
    status: int, message: str, open_drive: Open, feed: Feed
) -> None:
    emulator = Lms111Emulator()
    drive = open_drive(emulator.address)
    feed(emulator)
    drive.wait_scans(1)
    emulator.set_status(status)
    drive.wait_message(message)
    assert drive.wait_scans(10)[-1].device_status == status
    assert drive.driver.diagnostics["status"] == message
    drive.wait_state(OK)
    emulator.set_status(0)
    drive.wait_message("connected")
    wait_until(lambda: drive.driver.diagnostics["status"] == "ok")


def test_registered_again_when_the_scanner_forgot(open_drive: Open, feed: Feed) -> None:
    emulator = Lms111Emulator()
    drive = open_drive(emulator.address)
    feed(emulator)
    drive.wait_scans(3)
    emulator.stop_streaming()
    drive.wait_message("no scan for 0.5 s, though it measures")
    drive.wait_scans(3)
    drive.wait_message("connected")
    assert drive.driver.connects == 1


def test_a_pause_that_the_scanner_can_explain_costs_no_connection(open_drive: Open, feed: Feed) -> None:
    emulator = Lms111Emulator()
    drive = open_drive(emulator.address)
    feeder = feed(emulator)
    drive.wait_scans(3)
    feeder.stop()
    drive.wait_message("though it measures")
    time.sleep(1.0)
    assert drive.driver.connects == 1
    feed(emulator)
    drive.wait_scans(3)
    assert drive.driver.connects == 1
    assert drive.driver.diagnostics["scans lost"] == "0"
