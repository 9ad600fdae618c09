"""`check` with devices that are there or half there, on emulators at the wire."""

import json
from pathlib import Path
from typing import Any

import pytest

from hw_profiles.profile import load_profile
from rtlog_server.check import check_devices
from rtlog_server.cli import main


def test_devices_that_are_there_are_identified(
    drive: Any, drive_profile: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["check", "--profile", str(drive_profile)]) == 0
    heading, *rows = capsys.readouterr().out.splitlines()
    assert heading.startswith("device")
    assert [row.split()[0] for row in rows] == ["laser/primary", "encoders", "rfid"]
    assert [row.split()[2] for row in rows] == ["yes", "yes", "yes"]
    assert "serial_number 18090362" in rows[0]
    assert "US Digital A2" in rows[1]
    assert "ALR" in rows[2]


def test_json_tells_the_same(drive: Any, drive_profile: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", "--profile", str(drive_profile), "--json"]) == 0
    answers = json.loads(capsys.readouterr().out)
    assert all(answer["reachable"] and answer["advice"] == "" for answer in answers)
    assert answers[0]["identity"]["serial_number"] == "18090362"


def test_one_silent_encoder_is_named(drive: Any, drive_profile: Path) -> None:
    drive.encoders.mute(1)
    try:
        results = {result.device: result for result in check_devices(load_profile(drive_profile))}
    finally:
        drive.encoders.mute(1, muted=False)
    assert [device for device, result in results.items() if not result.reachable] == ["encoders"]
    assert results["encoders"].message == "no answer from right_wheel"
    assert "power" in results["encoders"].advice


def test_a_device_that_takes_the_connection_and_says_nothing_is_away(drive: Any, drive_profile: Path) -> None:
    drive.laser.go_silent()
    try:
        laser = check_devices(load_profile(drive_profile), time_limit_s=1.5)[0]
    finally:
        drive.laser.go_silent(silent=False)
    assert not laser.reachable
    assert "answers neither" in laser.message
