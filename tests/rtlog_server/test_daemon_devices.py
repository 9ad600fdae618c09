"""The server with all its devices at the wire: what was fed to the emulators arrives on zenoh, at the right time."""

import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from rtlog_server.messages import MISSING, OK, decode, to_ns
from rtlog_server.topics import BY_NAME

Drive = Any  # the fixture of conftest.py
EPC = "E2003411B802011526370494"


@pytest.fixture(scope="module")
def server(start_server: Callable[..., Any], drive: Drive) -> Any:
    server = start_server(**drive.places)
    server.wait_until(lambda: states(server) == {"laser/primary": OK, "encoders": OK, "rfid": OK}, timeout_s=10)
    server.received.clear()
    server.wait_until(lambda: len(messages(server, "rtlog/tick")) >= 20)
    return server


def messages(server: Any, topic: str) -> list[Any]:
    return [decode(sample.payload, BY_NAME[f"/{topic}"].msgtype) for sample in server.on(topic)]


def states(server: Any) -> dict[str, int]:
    ticks = messages(server, "rtlog/tick")
    return {sensor.name: sensor.state for sensor in ticks[-1].sensors} if ticks else {}


def test_every_tick_brings_every_sensor(server: Any) -> None:
    ticks = [sample.attachment.tick for sample in server.on("rtlog/tick")][:20]
    for topic in ("laser/primary/scan", "encoders/joint_states", "rfid/tags"):
        brought = {sample.attachment.tick for sample in server.on(topic)}
        assert len(brought.intersection(ticks)) >= 15, topic  # on a busy machine some come a tick later
    for tick in messages(server, "rtlog/tick")[:20]:
        ages = {sensor.name: sensor.age for sensor in tick.sensors}
        assert 0 < ages["laser/primary"] < 0.25
        assert 0 < ages["encoders"] < 0.35


def test_scans_arrive_whole_with_the_time_of_their_first_ray(server: Any, drive: Drive) -> None:
    utc_offset_ns = time.time_ns() - time.monotonic_ns()
    for scan in messages(server, "laser/primary/scan")[:20]:
        k = round((float(scan.ranges[0]) - 1.0) * 1e3)
        np.testing.assert_allclose(scan.ranges, 1.0 + k * 1e-3, atol=1e-6)
        assert len(scan.ranges) == len(scan.intensities) == drive.RAYS
        assert scan.angle_min == pytest.approx(math.radians(-135), abs=1e-5)
        assert to_ns(scan.header.stamp) - utc_offset_ns == pytest.approx(drive.first_rays_ns[k], abs=10e6)


def test_positions_are_true_at_their_stamp(server: Any, drive: Drive) -> None:
    utc_offset_ns = time.time_ns() - time.monotonic_ns()
    found = [message for message in messages(server, "encoders/joint_states")[:20] if len(message.name) == 2]
    assert len(found) >= 10  # an emulated encoder on a busy machine may answer too late
    assert all(message.name == ["left_wheel", "right_wheel"] for message in found)
    stamps_s = np.array([to_ns(message.header.stamp) - utc_offset_ns for message in found]) * 1e-9
    positions = np.array([message.position for message in found])
    for column, turns_per_s in enumerate(drive.TURNS_PER_S.values()):
        wrong_rad = positions[:, column] - 2 * math.pi * turns_per_s * stamps_s
        wrong_rad -= 2 * math.pi * round(wrong_rad[0] / (2 * math.pi))  # the count starts within one turn
        assert np.abs(wrong_rad).max() < 2 * math.pi * abs(turns_per_s) * 0.02  # 20 ms


def test_every_read_of_a_tag_is_counted(server: Any, drive: Drive) -> None:
    before = drive.tag_reads
    for _ in range(5):
        drive.read_tag(EPC)
        time.sleep(0.03)

    def reads() -> list[Any]:
        return [read for message in messages(server, "rfid/tags") for read in message.reads]

    server.wait_until(lambda: sum(read.count for read in reads()) >= drive.tag_reads - before)
    assert {read.epc for read in reads()} == {EPC}
    assert sum(read.count for read in reads()) == drive.tag_reads - before


def test_status_identifies_the_devices(server: Any) -> None:
    devices = server.status()["devices"]
    assert {device["state"] for device in devices.values()} == {"OK"}
    assert devices["laser/primary"]["identity"]["serial_number"] == "18090362"
    assert devices["encoders"]["identity"].keys() == {"left_wheel", "right_wheel"}
    assert all(device["connects"] == 1 for device in devices.values())


def test_a_device_that_goes_away_is_missing_and_comes_back(server: Any, drive: Drive) -> None:
    drive.laser.refuse()
    server.wait_until(lambda: states(server) == {"laser/primary": MISSING, "encoders": OK, "rfid": OK}, timeout_s=1.5)
    first = server.on("rtlog/tick")[-1].attachment.tick
    server.wait_until(lambda: server.on("rtlog/tick")[-1].attachment.tick >= first + 5)
    drive.laser.refuse(refusing=False)
    server.wait_until(lambda: states(server)["laser/primary"] == OK, timeout_s=3.0)
    ticks = [sample.attachment.tick for sample in server.on("rtlog/tick")]
    assert ticks == list(range(ticks[0], ticks[0] + len(ticks)))
    server.wait_until(lambda: server.status()["devices"]["laser/primary"]["connects"] == 2)
    levels = [
        {status.name: status.level for status in message.status}["laser/primary"]
        for message in messages(server, "diagnostics")
    ]
    assert levels.index(2) < len(levels) - 1  # told at once, and its return too
    assert levels[-1] == 0


def test_nothing_was_late_or_lost(server: Any) -> None:
    for topic in ("rtlog/tick", "laser/primary/scan", "encoders/joint_states", "rfid/tags"):
        numbers = [sample.attachment.sequence for sample in server.on(topic)]
        assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
    status, seconds = server.terminate()
    assert status == 0
    assert seconds < 2.0
    assert "Traceback" not in server.stderr.read_text()
