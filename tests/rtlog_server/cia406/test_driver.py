"""The CAN encoders' driver against emulated encoders, over python-can's buses and an slcan adapter on a terminal."""

import math
import time
from collections.abc import Callable
from typing import Any

import pytest
from wheels import Wheels

from hw_profiles.profile import CanBus, Encoder
from rtlog_server.devices.cia406 import protocol
from rtlog_server.devices.cia406.emulated_encoder import Entry
from rtlog_server.devices.cia406.emulator import CanBusEmulator
from rtlog_server.messages import OK

COUNTS = 4096
ADDRESSES = {"left_wheel": 5, "right_wheel": 9}
Start = Callable[..., Any]  # a running driver
Emulate = Callable[..., CanBusEmulator]
Position = Any  # the fixture of conftest.py


@pytest.mark.parametrize(("interface", "trigger"), [("udp", "sync"), ("slcan", "sync"), ("virtual", "timer")])
def test_positions_at_their_stamps_are_the_true_ones_over_many_turns(
    interface: str, trigger: str, request: pytest.FixtureRequest, start: Start, emulate: Emulate, turning: Position
) -> None:
    found = request.getfixturevalue(interface)
    bus = CanBus(interface=found.interface, channel=found.channel, udp_port=found.udp_port, trigger=trigger)
    with emulate(bus):
        host = start(bus)
        host.wait_for(lambda: sum(len(r.names) == 2 and not r.doubtful for r in host.readings) >= 20)
        host.wait_for(lambda: host.device.collect(time.monotonic_ns()).state == OK)
    wire_ns = protocol.wire_ns(8, bus.bitrate)
    for reading, looked_ns in zip(host.readings, turning.looked_ns(host.readings, ADDRESSES), strict=True):
        assert max(looked_ns.values()) <= reading.complete_ns
        if trigger == "sync":  # latched when it has come, all at one moment
            assert len(set(looked_ns.values())) == 1
            assert min(looked_ns.values()) >= reading.measured_ns - wire_ns
    first, *_, last = (reading for reading in host.readings if len(reading.names) == 2)
    for index, sign in enumerate((1, -1)):  # the right wheel counts backward
        turned_rad = sign * math.tau * (last.counts[index] - first.counts[index]) / COUNTS
        assert last.positions_rad[index] - first.positions_rad[index] == pytest.approx(turned_rad, abs=math.pi)
    host.assert_one_a_tick()


def test_encoders_say_who_they_are(virtual: CanBus, start: Start, emulate: Emulate) -> None:
    with emulate(virtual):
        host = start(virtual)
        host.wait_for(lambda: host.device.diagnostics.get("left_wheel") == "ok")
    assert host.device.identity["right_wheel"] == (
        "Emulated multi-turn encoder, node 9, vendor 0x2f1, product 0x406, revision 0x10002, serial number 83009"
    )


def test_only_what_differs_is_written(virtual: CanBus, start: Start, emulate: Emulate) -> None:
    with emulate(virtual) as emulator:
        first = start(virtual)
        first.wait_for_all()
        assert emulator.nodes[5].written == [(protocol.HEARTBEAT_MS, 200)]  # all else is a CiA 406 default
        first.device.close()
        second = start(virtual)
        second.wait_for_all()
        assert emulator.nodes[5].written == [(protocol.HEARTBEAT_MS, 200)]


def test_an_encoder_is_scaled_and_turned_as_the_profile_says(virtual: CanBus, start: Start, emulate: Emulate) -> None:
    left = Encoder(name="left_wheel", role="left_wheel", address=5, wheel_radius_m=0.35, counts_per_turn=1000)
    with emulate(virtual, wheel := Wheels({5: 0.5}, 65536), {5: 65536}) as emulator:
        emulator.wait_until_done()
        emulator.nodes[5].objects[protocol.OPERATING].value = protocol.REVERSED
        host = start(virtual, (left,))
        readings = host.wait_for_readings(10)
        objects = emulator.nodes[5].objects
        assert objects[protocol.UNITS_PER_TURN].value == 1000
        assert objects[protocol.TOTAL_RANGE].value == 1000 * 4096
        assert objects[protocol.OPERATING].value == protocol.SCALED
    assert {reading.counts[0] for reading in readings} <= {total * 1000 // 65536 for total, _ in wheel.looks[5]}
    assert readings[-1].counts > readings[0].counts


def test_an_encoder_that_will_not_be_scaled_is_refused(virtual: CanBus, start: Start, emulate: Emulate) -> None:
    with emulate(virtual, counts={5: 8192, 9: COUNTS}) as emulator:
        emulator.wait_until_done()
        emulator.nodes[5].objects[protocol.UNITS_PER_TURN].writable = False
        host = start(virtual)
        host.wait_for_message("left_wheel (node 5): does not take 4096: object 6001h:0: ")
        assert "read only object" in host.device.message
        assert {reading.names for reading in host.wait_for_readings(3)} == {("right_wheel",)}


@pytest.mark.parametrize(
    ("entries", "written"),
    [
        ([0x60300010, 0x60040020], False),  # after the speed
        ([0x60300010], True),  # it lacks the position
    ],
)
def test_the_position_is_found_in_the_pdo_or_put_there(
    entries: list[int], written: bool, virtual: CanBus, start: Start, emulate: Emulate
) -> None:
    with emulate(virtual, lambda _node, _at_ns: 777) as emulator:
        emulator.wait_until_done()
        objects = emulator.nodes[5].objects
        objects[(0x6030, 0)] = Entry(0xBEEF, 2)
        objects[(0x1A01, 0)].value = len(entries)
        for place, entry in enumerate(entries, start=1):
            objects[(0x1A01, place)].value = entry
        host = start(virtual)
        assert host.wait_for_all().counts == (777, 777)
        assert any(address[0] == 0x1A01 for address, _ in emulator.nodes[5].written) == written
        assert objects[(0x1801, protocol.COB_ID)].value == 0x285


def test_another_kind_of_device_under_an_id_is_named_and_let_alone(
    virtual: CanBus, start: Start, emulate: Emulate
) -> None:
    with emulate(virtual) as emulator:
        emulator.wait_until_done()
        drive = emulator.nodes[5]
        drive.objects[protocol.DEVICE_TYPE].value = 0x0002_0192
        drive.state = protocol.OPERATIONAL
        host = start(virtual)
        host.wait_for_message("left_wheel (node 5): is device profile 402 (drive), no encoder (406)")
        assert {reading.names for reading in host.wait_for_readings(3)} == {("right_wheel",)}
        assert drive.state == protocol.OPERATIONAL  # nobody stopped somebody else's machine
        assert drive.written == []


def test_an_encoder_of_another_vendor_is_named(virtual: CanBus, start: Start, emulate: Emulate) -> None:
    ours = CanBus(interface="virtual", channel=virtual.channel, vendor_id=0x2F1)
    other = CanBus(interface="virtual", channel=virtual.channel, vendor_id=0x77)
    with emulate(virtual):
        start(ours).wait_for_readings(1)
        host = start(other)
        host.wait_for_message("right_wheel (node 9): is of vendor 0x2f1; encoder_bus.vendor_id is 0x77")
        assert not host.device.connected


def test_steering_is_signed_about_its_zero(virtual: CanBus, start: Start, emulate: Emulate) -> None:
    steering = Encoder(name="steering", role="steering", address=7, zero_deg=355.0)
    with emulate(virtual, lambda _node, _at_ns: 3 * COUNTS + round(10 / 360 * COUNTS), {7: COUNTS}):
        reading = start(virtual, (steering,)).wait_for_readings(1)[0]
    assert reading.positions_rad == (pytest.approx(math.radians(15.0), abs=2e-3),)
