"""The CAN encoders' driver against emulated encoders, over python-can's buses and an slcan adapter on a terminal."""

import itertools
import math
import time
from collections.abc import Callable
from typing import Any

import pytest

from hw_profiles.profile import CanBus, Encoder
from rtlog_server.devices.cia406 import protocol
from rtlog_server.devices.cia406.emulated_encoder import Entry
from rtlog_server.devices.cia406.emulator import CanBusEmulator
from rtlog_server.messages import OK

COUNTS = 4096
PERIOD_NS = 40_000_000
LATCH_S = {"sync": 0.003, "timer": 0.006}
Start = Callable[..., Any]  # a running driver
Emulate = Callable[..., CanBusEmulator]
Position = Callable[[int, int], int]


@pytest.mark.parametrize(("interface", "trigger"), [("udp", "sync"), ("slcan", "sync"), ("virtual", "timer")])
def test_positions_at_their_stamps_are_the_true_ones_over_many_turns(
    interface: str, trigger: str, request: pytest.FixtureRequest, start: Start, emulate: Emulate, turning: Position
) -> None:
    found = request.getfixturevalue(interface)
    bus = CanBus(interface=found.interface, channel=found.channel, udp_port=found.udp_port, trigger=trigger)
    with emulate(bus):
        host = start(bus)
        readings = host.wait_for_readings(20)
        assert host.device.collect(time.monotonic_ns()).state == OK
    errors_s = []
    for reading in readings:
        assert reading.names == ("left_wheel", "right_wheel")
        assert reading.doubtful == ()
    for i, (node, sign) in enumerate(((5, 1), (9, -1))):
        true_turns = [turning(node, reading.measured_ns) / COUNTS for reading in readings]
        turns = [sign * reading.positions_rad[i] / math.tau for reading in readings]
        offset = round(turns[0] - true_turns[0])  # the encoders count no more than 4096 turns
        errors = [abs(told - true - offset) for told, true in zip(turns, true_turns, strict=True)]
        assert max(errors) < 1 / 4  # no turn too many or too few
        errors_s += [error / abs(turning(node, 10**9) / COUNTS) for error in errors]
    assert sorted(errors_s)[len(errors_s) * 3 // 4] < LATCH_S[trigger]  # the rest: a machine with other work
    assert abs(readings[-1].counts[0] - readings[0].counts[0]) > 1.2 * COUNTS
    settled = sorted(host.ages_s[5:])
    assert 0.004 <= settled[len(settled) // 2] < 0.015  # taken just before the tick
    stamps = [reading.measured_ns for reading in readings]
    assert all(after - before > 0.4 * PERIOD_NS for before, after in itertools.pairwise(stamps))


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
        first.wait_for_readings(1)
        assert emulator.nodes[5].written == [(protocol.HEARTBEAT_MS, 200)]  # all else is a CiA 406 default
        first.device.close()
        second = start(virtual)
        second.wait_for_readings(1)
        assert emulator.nodes[5].written == [(protocol.HEARTBEAT_MS, 200)]


def test_an_encoder_is_scaled_and_turned_as_the_profile_says(virtual: CanBus, start: Start, emulate: Emulate) -> None:
    left = Encoder(name="left_wheel", role="left_wheel", address=5, wheel_radius_m=0.35, counts_per_turn=1000)
    with emulate(virtual, lambda _, at_ns: round(at_ns * 1e-9 * 0.5 * 65536), {5: 65536}) as emulator:
        emulator.wait_until_done()
        emulator.nodes[5].objects[protocol.OPERATING].value = protocol.REVERSED
        host = start(virtual, (left,))
        readings = host.wait_for_readings(10)
        objects = emulator.nodes[5].objects
        assert objects[protocol.UNITS_PER_TURN].value == 1000
        assert objects[protocol.TOTAL_RANGE].value == 1000 * 4096
        assert objects[protocol.OPERATING].value == protocol.SCALED
    elapsed_s = (readings[-1].measured_ns - readings[0].measured_ns) * 1e-9
    assert readings[-1].counts[0] - readings[0].counts[0] == pytest.approx(500 * elapsed_s, abs=5)


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
        assert host.wait_for_readings(2)[-1].counts == (777, 777)
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
