"""`check` with devices that are there, half there or not well, on emulators at the wire."""

import json
import re
import socket
import time
from pathlib import Path
from typing import Any

import pytest
from patience import PATIENCE_S, wait_until

from hw_profiles.profile import CanBus, Profile, load_profile, parse_profile
from rtlog_server.check import check_devices
from rtlog_server.cli import main
from rtlog_server.devices.cia406.emulator import CanBusEmulator
from rtlog_server.devices.lms111.emulator import Lms111Emulator
from rtlog_server.finding import Finding

SILENT_WHEEL = [("encoders", "identity of right_wheel"), ("encoders", "driver")]
Found = dict[tuple[str, str], Finding]


def check(profile: Profile, wrong: list[tuple[str, str]], time_limit_s: float = 5.0) -> Found:
    """The findings by device and subject, once these are wrong: on a busy machine a rate may be so as well."""
    deadline = time.monotonic() + PATIENCE_S
    while True:
        results = check_devices(profile, time_limit_s, watch_s=1.0)
        found = {(device, finding.subject): finding for device, findings in results.items() for finding in findings}
        if [where for where, finding in found.items() if not finding.well] == wrong:
            return found
        assert time.monotonic() < deadline, found


def test_what_is_well_is_told(drive: Any, drive_profile: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["check", "--profile", str(drive_profile), "--json"]
    wait_until(lambda: capsys.readouterr() and main(command) == 0)  # on a busy machine a rate may be wrong at first
    rows = json.loads(capsys.readouterr().out)
    assert all(row.keys() == {"device", "subject", "found", "well", "advice"} for row in rows)
    assert all(row["well"] and row["advice"] == "" for row in rows)
    told = {f"{row['device']} {row['subject']}": row["found"] for row in rows}
    assert "serial number 18090362, firmware" in told["laser/primary identity"]
    assert told["laser/primary window"] == "clean"
    assert told["laser/primary rate"].endswith("Hz, wanted 50.0")
    assert told["laser/primary clock"].endswith("ms old by its stamp")
    assert "US Digital A2, address 0" in told["encoders identity of left_wheel"]
    assert told["encoders rate"].endswith("Hz, wanted 10.0")
    assert "ALR-9650" in told["rfid identity"]
    assert told["rfid antenna"].startswith("reads 0")
    assert "s from this board's" in told["rfid clock"]


def test_one_silent_encoder_is_named(drive: Any, drive_profile: Path) -> None:
    drive.encoders.mute(1)
    try:
        found = check(load_profile(drive_profile), SILENT_WHEEL)
    finally:
        drive.encoders.mute(1, muted=False)
    assert "address 1" in found["encoders", "identity of right_wheel"].advice
    assert found["encoders", "driver"].found == "no answer from right_wheel"


def test_a_device_that_takes_the_connection_and_says_nothing_is_away(drive: Any, drive_profile: Path) -> None:
    drive.laser.go_silent()
    try:
        found = check(load_profile(drive_profile), [("laser/primary", "reachable")], time_limit_s=1.5)
    finally:
        drive.laser.go_silent(silent=False)
    assert "answers neither" in found["laser/primary", "reachable"].found
    assert "power" in found["laser/primary", "reachable"].advice


def test_a_dirty_window_and_missing_scans_are_told_with_what_to_do(drive: Any, drive_profile: Path) -> None:
    drive.laser.set_status(2)
    drive.scan_s = 0.05
    try:
        found = check(load_profile(drive_profile), [("laser/primary", what) for what in ("window", "driver", "rate")])
    finally:
        drive.laser.set_status(0)
        drive.scan_s = 0.02
    assert found["laser/primary", "window"].found == "front window is dirty"
    assert "clean" in found["laser/primary", "window"].advice
    assert "cable" in found["laser/primary", "rate"].advice


def test_each_device_says_in_its_way_why_it_is_not_ready(drive: Any, drive_profile: Path) -> None:
    """A scanner that starts, a CAN adapter that is not plugged in, a reader that refuses our password."""
    bus = 'kind = "can"\ninterface = "slcan"\nchannel = "/dev/no-adapter"'
    text, count = re.subn(r"kind = .*\nport = .*", bus, drive_profile.read_text())
    reader = f"port = {drive.places['rfid_port']}"
    assert count == text.count(reader) == 1
    text = text.replace(reader, f'{reader}, password = "wrong"').replace("address = 0", "address = 5")
    with Lms111Emulator(start_s=60.0) as scanner:
        text = text.replace(f"port = {drive.places['laser_port']}", f"port = {scanner.address[1]}")
        wrong = [
            ("laser/primary", "state"),
            ("laser/primary", "driver"),
            ("encoders", "reachable"),
            ("rfid", "reachable"),
        ]
        found = check(parse_profile(text, "test"), wrong, time_limit_s=3.0)
    assert "does not measure yet" in found["laser/primary", "state"].found
    assert "wait" in found["laser/primary", "state"].advice
    assert "/dev/no-adapter: cannot open the CAN interface" in found["encoders", "reachable"].found
    assert "ls -l /dev/no-adapter" in found["encoders", "reachable"].advice
    assert "password" in found["rfid", "reachable"].found


def test_a_server_at_work_is_left_alone(drive: Any, drive_profile: Path, capsys: pytest.CaptureFixture[str]) -> None:
    port = int(drive_profile.read_text().rsplit(":", 1)[1].split('"')[0])
    with socket.create_server(("127.0.0.1", port)):
        assert main(["check", "--profile", str(drive_profile)]) == 1
    assert "the server is running" in capsys.readouterr().err


def test_encoders_on_can_are_asked_by_their_driver(drive: Any, drive_profile: Path) -> None:
    bus = CanBus(channel=str(drive_profile.parent), interface="virtual")
    text, count = re.subn(
        r"kind = .*\nport = .*",
        f'kind = "can"\ninterface = "virtual"\nchannel = "{bus.channel}"',
        drive_profile.read_text(),
    )
    assert count == 1
    profile = parse_profile(text.replace("address = 0", "address = 5").replace("address = 1", "address = 9"), "test")
    with CanBusEmulator(bus, {5: 4096, 9: 4096}, lambda _, now_ns: now_ns // 1_000_000) as emulator:
        found = check(profile, [])
        assert "node 5" in found["encoders", "identity of left_wheel"].found
        assert "no errors" in found["encoders", "bus"].found
        emulator.mute(9)
        found = check(profile, SILENT_WHEEL)
    assert "node id 9" in found["encoders", "identity of right_wheel"].advice
