"""The driver and all that can happen to a scanner: when it is back, so is the driver, and nothing is left behind."""

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from patience import PATIENCE_S, in_use, left_behind, wait_until

from rtlog_server.devices import device
from rtlog_server.devices.lms111 import connection, driver
from rtlog_server.devices.lms111.cola import Dialect
from rtlog_server.devices.lms111.emulator import Lms111Emulator
from rtlog_server.devices.lms111.protocol import ERRORS
from rtlog_server.devices.lms111.scan_data import Channel, ScanData, encode_scan_data
from rtlog_server.messages import MISSING

Open = Feed = Callable[..., Any]


def test_the_scanner_comes_after_the_driver(open_drive: Open, feed: Feed) -> None:
    with Lms111Emulator() as gone:
        address = gone.address
    drive = open_drive(address)
    drive.wait_message("refused")
    assert f"LMS111 at 127.0.0.1:{address[1]}" in drive.driver.message
    time.sleep(1.0)  # by now it tries but once a second
    drive.wait_state(MISSING)
    late = Lms111Emulator(port=address[1], dialect="A")  # which the driver tries last
    feed(late)
    drive.wait_scans(1)


@pytest.mark.parametrize("dialect", ["A", "B"])
def test_back_after_a_reset(dialect: str, open_drive: Open, feed: Feed) -> None:
    emulator = Lms111Emulator(dialect=dialect)
    drive = open_drive(emulator.address)
    feed(emulator)
    drive.wait_scans(5)
    drive.lose(emulator.drop_connection)
    assert drive.told("LMS111 at")
    drive.wait_scans(5)
    assert drive.driver.connects == 2


def test_back_after_refusal(open_drive: Open, feed: Feed) -> None:
    emulator = Lms111Emulator()
    drive = open_drive(emulator.address)
    feed(emulator)
    drive.wait_scans(5)
    emulator.refuse()
    drive.wait_message("refused")
    drive.wait_state(MISSING)
    emulator.refuse(False)
    drive.wait_scans(5)


def test_a_pulled_cable_is_noticed_and_back_when_it_is_plugged_in(
    open_drive: Open, feed: Feed, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(driver, "PROBE_S", 0.25)
    emulator = Lms111Emulator(dialect="A")
    drive = open_drive(emulator.address)
    feed(emulator)
    drive.wait_scans(5)
    emulator.go_silent()
    drive.wait_message("no scan for 0.5 s, and no answer")
    drive.wait_message("answers neither")
    emulator.go_silent(False)
    drive.wait_scans(5)
    assert drive.driver.diagnostics["dialect"] == "CoLa A"


def test_a_power_cycle_starts_the_clock_and_the_counters_anew(open_drive: Open, feed: Feed) -> None:
    emulator = Lms111Emulator(clock_offset_us=1_000_000_000)
    drive = open_drive(emulator.address)
    feeder = feed(emulator)
    before = drive.wait_scans(20)
    scans = drive.lose(lambda: emulator.power_cycle(off_s=0.3)) + drive.wait_scans(20)
    anew = [scan.telegram_counter for scan in scans].index(1)
    after, arrived_ns = scans[anew:], drive.arrived_ns[len(before) :][anew : len(scans)]
    assert before[-1].telegram_counter > 5
    assert [scan.telegram_counter for scan in after] == list(range(1, len(after) + 1))
    assert after[0].scan_time_s == pytest.approx(0.02, rel=1e-3)  # it had fallen back to 25 Hz
    feeder.assert_true_stamps(after, arrived_ns)
    assert drive.driver.diagnostics["scans lost"] == "0"


@pytest.mark.parametrize("dialect", ["A", "B"])
@pytest.mark.parametrize(
    "garbage",
    [b"\xff\x00garbage\x02\x02", 4 * b"\x02" + b"\x00\x00\x04\x9esSN LMDscandata \x00\x01", b"\x02sSN LMDscandata 1 1"],
)
def test_garbage_and_cut_telegrams_cost_no_connection(
    dialect: str, garbage: bytes, open_drive: Open, feed: Feed
) -> None:
    emulator = Lms111Emulator(dialect=dialect)
    drive = open_drive(emulator.address)
    feeder = feed(emulator)
    drive.wait_scans(3)
    emulator.send_raw(garbage)
    scans = drive.wait_scans(5)
    assert drive.driver.connects == 1
    assert int(drive.driver.diagnostics["garbage [bytes]"]) >= len(garbage) - 2
    indices = [feeder.index(scan) for scan in scans]
    assert indices == list(range(indices[0], indices[0] + len(indices)))


@pytest.mark.parametrize("dialect", ["A", "B"])
def test_a_telegram_that_is_no_scan_is_counted_and_let_pass(dialect: str, open_drive: Open, feed: Feed) -> None:
    emulator = Lms111Emulator(dialect=dialect)
    drive = open_drive(emulator.address)
    feed(emulator)
    drive.wait_scans(3)
    payload = b"sSN LMDscandata 1 1"
    framed = b"\x02" + payload + b"\x03" if dialect == "A" else bytes.fromhex("0202020200000013") + payload
    emulator.send_raw(
        framed if dialect == "A" else framed + bytes([np.bitwise_xor.reduce(np.frombuffer(payload, "u1"))])
    )
    drive.wait_scans(5)
    assert drive.driver.diagnostics["bad telegrams"] == "1"
    assert "ends early" in drive.driver.diagnostics["last bad telegram"]
    assert drive.driver.connects == 1


def test_a_changed_dialect_is_found(open_drive: Open, feed: Feed) -> None:
    emulator = Lms111Emulator(dialect="B")
    drive = open_drive(emulator.address)
    feeder = feed(emulator)
    drive.wait_scans(1)
    feeder.stop()
    emulator.close()
    drive.lose(lambda: feed(Lms111Emulator(port=emulator.address[1], dialect="A")))
    drive.wait_scans(1)
    assert drive.driver.diagnostics["dialect"] == "CoLa A"


def test_back_when_the_scanner_hangs_up(open_drive: Open, feed: Feed) -> None:
    emulator = Lms111Emulator()
    drive = open_drive(emulator.address)
    feed(emulator)
    drive.wait_scans(3)
    drive.lose(lambda: emulator.drop_connection(reset=False))
    assert drive.told("closed the connection")
    drive.wait_scans(3)


@pytest.mark.parametrize("dialect", list(Dialect))
def test_a_telegram_in_two_pieces_with_a_pause(dialect: Dialect, open_drive: Open, feed: Feed) -> None:
    emulator = Lms111Emulator(dialect=dialect.name)
    drive = open_drive(emulator.address)
    feeder = feed(emulator)
    drive.wait_scans(3)
    feeder.stop()
    wait_until(lambda: drive.collect() is not None and feeder.index(drive.scans[-1]) == len(feeder.first_rays_ns) - 1)
    newest = drive.scans[-1]
    channel = Channel("DIST1", 1.0, 0.0, -450_000, 5000, np.full(541, 4321, np.uint16))
    counters = newest.telegram_counter + 100, newest.scan_counter + 100
    scan = ScanData(1, 1, 1, (0, 0), *counters, 5000, 28_000, (0, 0), (0, 0), 0, 5000, 360, (), (channel,), ())
    telegram = encode_scan_data(dialect, scan)
    emulator.send_raw(telegram[:300])
    time.sleep(0.05)
    emulator.send_raw(telegram[300:])
    while newest.telegram_counter != counters[0]:
        newest = drive.wait_scans(1)[-1]
    assert set(newest.ranges_m.tolist()) == {np.float32(4.321)}
    assert drive.driver.connects == 1
    assert drive.driver.diagnostics["garbage [bytes]"] == "0"


COMMANDS = (
    "sMN SetAccessMode",
    "sRN FirmwareVersion",
    "sRN LMPscancfg",
    "sMN mLMPsetscancfg",
    "sRN LMPoutputRange",
    "sWN LMPoutputRange",
    "sRN LMDscandatacfg",
    "sWN LMDscandatacfg",
    "sMN LMCstartmeas",
    "sRN STlms",
    "sMN Run",
    "sEN LMDscandata",
)


@pytest.mark.parametrize(("command", "code"), list(zip(COMMANDS, ERRORS, strict=False)))
def test_an_error_is_told_by_name_and_tried_again(command: str, code: int, open_drive: Open, feed: Feed) -> None:
    emulator = Lms111Emulator(dialect="AB"[code % 2])
    emulator.set_error(command, code)
    drive = open_drive(emulator.address)
    feed(emulator)
    drive.wait_message(f"refuses {command}: {ERRORS[code]} (sFA {code})")
    emulator.set_error(command, None)
    drive.wait_scans(2)


@pytest.mark.parametrize("dialect", ["A", "B"])
@pytest.mark.parametrize("unit", [b"\xff", b"\x02\x02\x02\x02\0\0\x0f\xffs", b"\x02sFA 3\x03"])
def test_a_flood_ends_the_connection_and_no_more(
    dialect: str, unit: bytes, open_drive: Open, feed: Feed, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(driver, "PROBE_S", 0.25)
    emulator = Lms111Emulator(dialect=dialect)
    drive = open_drive(emulator.address)
    feed(emulator)
    drive.wait_scans(2)
    megabyte = unit * (2**20 // len(unit))
    while drive.driver.connects == 1 and drive.driver.connected:
        emulator.send_raw(megabyte)
    assert any(drive.told(word) for word in ("floods", "no scan for", "refuses"))  # whichever it met first
    drive.wait_scans(2)


def test_reconnects_leave_nothing_behind(open_drive: Open, feed: Feed) -> None:
    """A few here, a thousand in the long tests."""
    emulator = Lms111Emulator()
    drive = open_drive(emulator.address)
    feed(emulator)
    drive.wait_scans(1)
    before = in_use()
    for number in range(30):
        drive.lose(lambda: emulator.drop_connection(reset=number % 2 == 0))  # noqa: B023
        drive.wait_scans(1)
    assert drive.driver.connects >= 31
    wait_until(lambda: not left_behind(before))


def test_no_wait_outlasts_a_close(open_drive: Open, feed: Feed, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever the driver waits for, here for ten minutes."""
    for module, wait in ((connection, "PROBE_S"), (driver, "POLL_S"), (device, "RETRY_FIRST_S")):
        monkeypatch.setattr(module, wait, 600.0)
    emulator = Lms111Emulator(start_s=60)
    silent = Lms111Emulator()
    silent.go_silent()
    feed(silent)
    feed(emulator)
    for address, waits in (
        (emulator.address, lambda told: told("is in preparation")),
        (silent.address, lambda _: silent._client is not None),
        (("127.0.0.1", 9), lambda told: told("refused")),
    ):
        drive = open_drive(address)
        wait_until(lambda: waits(drive.told))  # noqa: B023
        drive.driver.close(timeout_s=PATIENCE_S)
        assert not drive.driver._thread.is_alive()
