"""The server with all its devices at the wire: what was fed to the emulators arrives on zenoh, at the right time."""

import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from rtlog_server.messages import MISSING, OK, decode, to_ns
from rtlog_server.ticker import utc_offset_ns
from rtlog_server.topics import BY_NAME

Drive = Any  # the fixture of conftest.py
EPC = "E2003411B802011526370494"
CLOCKS_NS = 1_000_000  # by which wall clock and monotonic clock may part while a server runs
SHIFT_NS = 50_000_000  # over which a speed brings positions of one round to one stamp, and its own error


@pytest.fixture(scope="module")
def server(start_server: Callable[..., Any], drive: Drive) -> Any:
    server = start_server(**drive.places)
    server.wait_until(lambda: states(server) == {"laser/primary": OK, "encoders": OK, "rfid": OK})
    server.received.clear()
    server.wait_until(lambda: len(messages(server, "rtlog/tick")) >= 20)
    return server


def messages(server: Any, topic: str) -> list[Any]:
    return [decode(sample.payload, BY_NAME[f"/{topic}"].msgtype) for sample in server.on(topic)]


def messages_by_tick(server: Any, topic: str) -> dict[int, Any]:
    ticks = [sample.attachment.tick for sample in server.on(topic)]
    return dict(zip(ticks, messages(server, topic), strict=False))


def states(server: Any) -> dict[str, int]:
    ticks = messages(server, "rtlog/tick")
    return {sensor.name: sensor.state for sensor in ticks[-1].sensors} if ticks else {}


def test_ticks_bring_every_sensor(server: Any) -> None:
    for topic in ("laser/primary/scan", "encoders/joint_states", "rfid/tags"):
        server.wait_until(lambda: len(server.on(topic)) >= 15)  # noqa: B023
        brought = [sample.attachment.tick for sample in server.on(topic)]
        assert sorted(set(brought)) == brought  # on a busy machine some come a tick later; none come twice
    for tick in messages(server, "rtlog/tick"):
        ages = {sensor.name: sensor.age for sensor in tick.sensors}
        assert ages["laser/primary"] > 0
        assert ages["encoders"] > 0


def test_scans_arrive_whole_with_the_time_of_their_first_ray(server: Any, drive: Drive) -> None:
    offset_ns, late_ns = utc_offset_ns(), []
    for scan in messages(server, "laser/primary/scan")[:20]:
        k = round((float(scan.ranges[0]) - 1.0) * 1e3)
        np.testing.assert_allclose(scan.ranges, 1.0 + k * 1e-3, atol=1e-6)
        assert len(scan.ranges) == len(scan.intensities) == drive.RAYS
        assert scan.angle_min == pytest.approx(math.radians(-135), abs=1e-5)
        late_ns.append(to_ns(scan.header.stamp) - offset_ns - drive.first_rays_ns[k])
    assert min(late_ns) > -CLOCKS_NS
    assert np.diff(late_ns).max() < CLOCKS_NS  # it is the fastest delivery so far, and no late one makes it grow


def test_positions_are_true_at_their_stamp(server: Any, drive: Drive) -> None:
    states, offset_ns = messages_by_tick(server, "encoders/joint_states"), utc_offset_ns()
    server.wait_until(lambda: messages_by_tick(server, "rtlog/tick").keys() >= states.keys())
    ticks = messages_by_tick(server, "rtlog/tick")
    for tick, state in states.items():
        if len(state.name) == 2:  # an emulated encoder on a busy machine may answer too late
            assert list(state.name) == ["left_wheel", "right_wheel"]
            stamp_ns, scheduled_ns = to_ns(state.header.stamp) - offset_ns, to_ns(ticks[tick].scheduled) - offset_ns
            late_ns = drive.late_ns(state.position, stamp_ns)
            assert late_ns.min() > -SHIFT_NS
            assert stamp_ns + late_ns.max() < scheduled_ns + SHIFT_NS
    assert any(len(state.name) == 2 for state in states.values())


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
    assert devices["laser/primary"]["identity"]["serial_number"] == "18090362"
    assert devices["encoders"]["identity"].keys() == {"left_wheel", "right_wheel"}
    server.wait_until(lambda: {device["state"] for device in server.status()["devices"].values()} == {"OK"})


def test_a_device_that_goes_away_is_missing_and_comes_back(server: Any, drive: Drive) -> None:
    drive.laser.refuse()
    server.wait_until(lambda: states(server) == {"laser/primary": MISSING, "encoders": OK, "rfid": OK})
    first = server.on("rtlog/tick")[-1].attachment.tick
    server.wait_until(lambda: server.on("rtlog/tick")[-1].attachment.tick >= first + 5)
    drive.laser.refuse(refusing=False)
    server.wait_until(lambda: states(server)["laser/primary"] == OK)
    ticks = [sample.attachment.tick for sample in server.on("rtlog/tick")]
    assert ticks == list(range(ticks[0], ticks[0] + len(ticks)))
    server.wait_until(lambda: server.status()["devices"]["laser/primary"]["connects"] >= 2)

    def levels() -> list[int]:
        told = [{status.name: status.level for status in array.status} for array in messages(server, "diagnostics")]
        return [of["laser/primary"] for of in told]

    server.wait_until(lambda: 2 in levels() and levels()[-1] == 0)


def test_nothing_was_lost(server: Any) -> None:
    for topic in ("rtlog/tick", "laser/primary/scan", "encoders/joint_states", "rfid/tags"):
        numbers = [sample.attachment.sequence for sample in server.on(topic)]
        assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
    assert server.terminate() == 0
    assert "Traceback" not in server.stderr.read_text()
