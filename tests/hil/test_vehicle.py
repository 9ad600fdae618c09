"""What every vehicle's devices do, real or emulated: with --hw-profile FILE on the bench in front of you.

Nothing here needs to know what the devices see: it may be a wall, wheels that stand and no tag at all.
"""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hw_profiles.profile import Profile, load_profile
from rtlog_client.audit import audit
from rtlog_client.log_file import read_messages
from rtlog_server.messages import OK, decode, to_ns
from rtlog_server.topics import AUXILIARY_SCAN, JOINT_STATES, PRIMARY_SCAN, TAGS, TICK

SECONDS = 15
SETTLE_TICKS = 50  # devices connect; a scanner that starts its motor may take longer: then start it before
LEAST = 0.95  # of the ticks; a busy machine may be late now and then

Recorded = tuple[Profile, Path]


@pytest.fixture(scope="module")
def checked(vehicle: Any) -> Any:
    """What `rtlog-server check` says, before the server has the devices."""
    line = [sys.executable, "-m", "rtlog_server.cli", "check", "--profile", str(vehicle.profile), "--json"]
    done = subprocess.run(line, capture_output=True, text=True, check=False, cwd=Path(__file__).parents[2])
    assert done.returncode in (0, 1), done.stderr
    return done.returncode, json.loads(done.stdout)


@pytest.fixture(scope="module")
def recorded(vehicle: Any, checked: Any) -> Recorded:
    """A quarter of a minute of it."""
    with vehicle.running("--duration", SETTLE_TICKS / 10 + SECONDS) as (_, recorder):
        recorder.finish(timeout_s=30)
    return load_profile(vehicle.profile), vehicle.folder / "out.mcap"


def messages(path: Path, topic: Any) -> list[tuple[int, Any]]:
    """After the devices have connected: tick's time and content."""
    ticks = [message.log_time_ns for message in read_messages(path, [TICK.name])]
    later = [m for m in read_messages(path, [topic.name]) if m.log_time_ns >= ticks[SETTLE_TICKS]]
    return [(message.log_time_ns, decode(message.data, message.msgtype)) for message in later]


def test_every_device_is_found_and_says_who_it_is(checked: Any) -> None:
    status, devices = checked
    assert status == 0, [d for d in devices if not d["well"]]
    assert {device["device"] for device in devices} >= {"laser/primary"}


def test_the_recording_keeps_the_contract(recorded: Recorded) -> None:
    result = audit(recorded[1])
    assert result.ok, [check for check in result.checks if not check.ok]


def test_every_device_is_well_at_every_tick(recorded: Recorded) -> None:
    ticks = messages(recorded[1], TICK)
    assert len(ticks) >= 10 * SECONDS - 20
    for number, sensor in enumerate(ticks[0][1].sensors):
        well = sum(tick.sensors[number].state == OK for _, tick in ticks)
        assert well >= LEAST * len(ticks), sensor.name


def test_a_tick_has_the_newest_scan(recorded: Recorded) -> None:
    profile, path = recorded
    lasers = ((PRIMARY_SCAN, profile.lasers.primary), (AUXILIARY_SCAN, profile.lasers.auxiliary))
    for topic in [topic for topic, laser in lasers if laser is not None]:
        scans = messages(path, topic)
        assert len(scans) >= LEAST * len(messages(path, TICK))
        ages_s = np.array([tick_ns - to_ns(scan.header.stamp) for tick_ns, scan in scans]) * 1e-9
        assert ages_s.min() > 0
        assert np.quantile(ages_s, LEAST) < 0.08  # its sweep, the turn after it, the way here
        assert len({len(scan.ranges) for _, scan in scans}) == 1


def test_encoders_are_read_just_before_the_tick(recorded: Recorded) -> None:
    profile, path = recorded
    if not profile.encoders:
        pytest.skip("this vehicle has no encoders")
    states = messages(path, JOINT_STATES)
    assert len(states) >= LEAST * len(messages(path, TICK))
    names = {encoder.name for encoder in profile.encoders}
    assert all(set(state.name) == names for _, state in states)
    ages_s = np.array([tick_ns - to_ns(state.header.stamp) for tick_ns, state in states]) * 1e-9
    assert ages_s.min() > 0
    assert np.quantile(ages_s, LEAST) < 0.03
    for wheel in [encoder for encoder in profile.encoders if encoder.role != "steering"]:
        angles = np.array([state.position[list(state.name).index(wheel.name)] for _, state in states])
        assert np.abs(np.diff(angles)).max() * (wheel.wheel_radius_m or 0) < 1.0, wheel.name  # m in a tick


def test_the_reader_answers_at_every_tick(recorded: Recorded) -> None:
    profile, path = recorded
    if profile.rfid is None:
        pytest.skip("this vehicle has no reader")
    assert len(messages(path, TAGS)) >= LEAST * len(messages(path, TICK))
