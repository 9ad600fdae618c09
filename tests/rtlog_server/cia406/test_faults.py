"""Whatever an encoder, the bus or its adapter does: it is told, the other encoder goes on, and what is back is read."""

import itertools
import os
import socket
import threading
import time
from collections.abc import Callable
from typing import Any

import can
import pytest
from patience import PATIENCE_S, in_use, left_behind, wait_until

from hw_profiles.profile import CanBus, Encoder
from rtlog_server.devices.cia406 import protocol
from rtlog_server.devices.cia406.driver import Cia406Encoders
from rtlog_server.devices.cia406.emulator import CanBusEmulator
from rtlog_server.devices.cia406.protocol import Frame
from rtlog_server.devices.device import TickGrid
from rtlog_server.messages import MISSING

COUNTS = 4096
PERIOD_NS = 40_000_000
Start = Callable[..., Any]  # a running driver
Emulate = Callable[..., CanBusEmulator]


def test_an_encoder_that_falls_silent_costs_the_other_nothing_and_is_back(
    virtual: CanBus, start: Start, emulate: Emulate
) -> None:
    with emulate(virtual) as emulator:
        host = start(virtual)
        host.wait_for_readings(3)
        emulator.mute(5)
        host.wait_for(lambda: host.readings[-1].names == ("right_wheel",))
        host.wait_for_message("left_wheel (node 5): ")
        assert {reading.names for reading in host.wait_for_readings(9)} == {("right_wheel",)}
        emulator.mute(5, muted=False)
        assert "left_wheel" not in host.wait_for_all().doubtful  # it counts turns itself
        host.wait_for(lambda: host.device.message == "connected")
        assert host.device.connects == 1


def test_turns_that_a_single_turn_encoder_may_have_missed_are_doubtful(
    virtual: CanBus, start: Start, emulate: Emulate
) -> None:
    with emulate(virtual) as emulator:
        emulator.wait_until_done()
        for node in (5, 9):
            emulator.nodes[node].objects[protocol.TURNS].value = 1
            emulator.nodes[node].objects[protocol.TOTAL_RANGE].value = COUNTS
        host = start(virtual)
        host.wait_for_readings(3)
        emulator.mute(5)
        host.wait_for_message("left_wheel (node 5): ")
        host.wait_for_readings(8)  # so long that the wheel's speed tells no more
        muted = len(host.readings)
        emulator.mute(5, muted=False)
        host.wait_for_all()
        first = next(reading for reading in host.readings[muted:] if "left_wheel" in reading.names)
        assert "left_wheel" in first.doubtful


def test_a_bus_that_fell_silent_is_opened_anew_until_it_answers(udp: CanBus, start: Start, emulate: Emulate) -> None:
    with emulate(udp) as emulator:
        host = start(udp)
        host.wait_for_readings(3)
        for node in (5, 9):
            emulator.mute(node)
        host.wait_for(lambda: host.device.collect(time.monotonic_ns()).state == MISSING)
        host.wait_for_message("udp_multicast:239.74.163.2: left_wheel (node 5): no answer")
        for node in (5, 9):
            emulator.mute(node, muted=False)
        host.wait_for_readings(1)


def test_an_encoder_that_restarts_is_configured_again_while_the_other_goes_on(
    virtual: CanBus, start: Start, emulate: Emulate
) -> None:
    with emulate(virtual) as emulator:
        host = start(virtual)
        host.wait_for_readings(3)
        emulator.power_cycle(5)
        host.wait_for(lambda: host.device.diagnostics["restarts"] == "1")
        host.wait_for_all()
        assert emulator.nodes[5].written == [(protocol.HEARTBEAT_MS, 200)] * 2
        assert emulator.nodes[9].written == [(protocol.HEARTBEAT_MS, 200)]  # which went on
        assert host.device.connects == 1


@pytest.mark.parametrize("command", [protocol.STOP, protocol.ENTER_PRE_OPERATIONAL])
def test_an_encoder_that_somebody_stopped_is_started_again(
    command: int, virtual: CanBus, start: Start, emulate: Emulate
) -> None:
    with emulate(virtual) as emulator:
        host = start(virtual)
        host.wait_for_readings(3)
        emulator.nodes[5].take(protocol.nmt_command(command, 5), time.monotonic_ns())
        host.wait_for(lambda: emulator.nodes[5].state == protocol.OPERATIONAL)
        host.wait_for(lambda: any(len(reading.names) == 1 for reading in host.readings))
        host.wait_for_all()


def test_a_pdo_that_somebody_switched_off_is_switched_on_again(virtual: CanBus, start: Start, emulate: Emulate) -> None:
    with emulate(virtual) as emulator:
        host = start(virtual)
        host.wait_for_readings(3)
        emulator.nodes[5].objects[(0x1801, protocol.COB_ID)].value = 0x285 | protocol.PDO_DISABLED
        host.wait_for(lambda: any(reading.names == ("right_wheel",) for reading in host.readings))
        host.wait_for_all()


def test_an_emergency_is_told_until_it_is_over(virtual: CanBus, start: Start, emulate: Emulate) -> None:
    with emulate(virtual) as emulator:
        host = start(virtual)
        host.wait_for_readings(1)
        emulator.emergency(9, 0x4210, vendor=b"\x01\x02")
        told = "emergency 4210h, temperature, error register 81h, vendor's 01 02 00 00 00"
        host.wait_for(lambda: host.device.message == f"right_wheel: {told}")
        assert host.device.diagnostics["right_wheel"] == told
        host.wait_for_all()
        emulator.emergency(9, 0)
        host.wait_for(lambda: host.device.message == "connected")


def test_a_second_node_with_the_same_id_is_noticed(virtual: CanBus, start: Start, emulate: Emulate) -> None:
    with emulate(virtual) as emulator:
        host = start(virtual)
        host.wait_for_readings(2)
        with can.Bus(interface="virtual", channel=virtual.channel) as second:
            while "left_wheel: two nodes answer to its id" not in host.device.message:
                frame = second.recv(PATIENCE_S)
                assert frame is not None
                if frame.arbitration_id == protocol.SYNC:
                    second.send(can.Message(arbitration_id=0x285, data=b"\x07\0\0\0", is_extended_id=False))
        host.wait_for(lambda: host.device.message == "connected")
        assert emulator.nodes[5].state == protocol.OPERATIONAL


def test_what_an_encoder_complains_of_at_the_start_is_told(virtual: CanBus, start: Start, emulate: Emulate) -> None:
    with emulate(virtual) as emulator:
        emulator.wait_until_done()
        emulator.nodes[5].objects[protocol.ALARMS].value = 1
        host = start(virtual)
        host.wait_for(lambda: host.device.diagnostics.get("left_wheel") == "alarms 01h")


def test_an_adapter_that_comes_late_is_pulled_and_put_back_is_read(
    slcan: CanBus, start: Start, emulate: Emulate
) -> None:
    host = start(slcan)
    host.wait_for_message("cannot open the CAN interface: No such file or directory")
    with emulate(slcan) as emulator:
        host.wait_for_readings(3)
        emulator.unplug()
        host.wait_for(lambda: not host.device.connected)
        host.wait_for_message("No such file or directory")
        emulator.replug()
        host.wait_for_readings(1)
        assert host.device.connects >= 2


def test_bus_off_is_named_and_survived(virtual: CanBus, start: Start, emulate: Emulate) -> None:
    with emulate(virtual), can.Bus(interface="virtual", channel=virtual.channel) as kernel:
        host = start(virtual)
        host.wait_for_readings(1)
        kernel.send(can.Message(arbitration_id=0x40, is_error_frame=True, is_extended_id=False, data=bytes(8)))
        host.wait_for_message("bus-off")
        host.wait_for(lambda: host.device.connects >= 2)
        host.wait_for_readings(1)


def test_an_interface_that_is_not_there_is_told(start: Start) -> None:
    host = start(CanBus(channel="rtlog-none0"))
    host.wait_for_message("socketcan:rtlog-none0: cannot open the CAN interface: ")
    assert "\n" not in host.device.message


@pytest.mark.parametrize("interface", ["udp", "slcan", "virtual"])
def test_reconnects_leak_neither_threads_nor_descriptors(
    interface: str, request: pytest.FixtureRequest, start: Start, emulate: Emulate, two_wheels: tuple[Encoder, ...]
) -> None:
    """A quick share; tests/hil has a thousand."""
    bus = request.getfixturevalue(interface)
    with emulate(bus):
        device = Cia406Encoders("encoders", bus, two_wheels)
        device.grid = TickGrid(time.monotonic_ns(), PERIOD_NS)
        device.connect()
        device.disconnect()
        before = in_use()
        for _ in range(8):
            device.connect()
            device.disconnect()
        wait_until(lambda: not left_behind(before))


GARBAGE = (
    Frame(0x705, b""),
    Frame(0x705, bytes(8)),
    Frame(0x085, b"\x00"),
    Frame(0x585, b"\x80\x00"),
    Frame(0x285, b""),
    Frame(0x285, b"\xff" * 8),
    Frame(0x285, b"\x01\x02\x03"),
    Frame(0x585, b"\x80" + bytes(7)),  # an abort that nobody asked for
    Frame(0x589, b"\x60" + bytes(7)),
)


def test_garbage_and_a_flood_of_foreign_frames_cost_no_reading(virtual: CanBus, start: Start, emulate: Emulate) -> None:
    stopping = threading.Event()
    with emulate(virtual) as emulator, can.Bus(interface="virtual", channel=virtual.channel) as foreign:

        def flood() -> None:
            identifiers = itertools.cycle(range(0x181, 0x800, 7))
            while not stopping.wait(0.0003):
                can_id = next(identifiers)
                if can_id & 0x7F not in (5, 9):
                    foreign.send(can.Message(arbitration_id=can_id, data=bytes(8), is_extended_id=False))

        host = start(virtual)
        host.wait_for_readings(2)
        thread = threading.Thread(target=flood)
        thread.start()
        for frame in GARBAGE * 2:
            emulator.send(frame)
            host.wait_for_readings(1)
        stopping.set()
        thread.join()
        assert int(host.device.diagnostics["garbled"]) >= 6 * 2
        assert all(not reading.doubtful for reading in host.readings)
        host.wait_for_all()
        assert host.device.connects == 1


def test_noise_of_an_slcan_adapter_is_waded_through(slcan: CanBus, start: Start, emulate: Emulate) -> None:
    with emulate(slcan) as emulator:
        host = start(slcan)
        host.wait_for_readings(2)
        for noise in (b"\xff\xfe\x80\r", b"t28", b"txyz!\r", b"t285F00\r", b"t\r", b"z" * 3000, b"z" * 3000, b"\r\r"):
            emulator.adapter_noise(noise)
            host.wait_for_readings(2)
        assert int(host.device.diagnostics["noise"]) >= 3
        assert host.device.connects == 1


def test_noise_on_the_multicast_group_is_waded_through(udp: CanBus, start: Start, emulate: Emulate) -> None:
    noise = (b"", b"\x00", b"not msgpack", b"\x81\xa1a\x01", os.urandom(3000))
    with emulate(udp), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
        host = start(udp)
        host.wait_for_readings(2)
        for datagram in noise * 2:
            sender.sendto(datagram, (udp.channel, udp.udp_port))
            host.wait_for_readings(1)
        host.wait_for(lambda: int(host.device.diagnostics["noise"]) >= 8)
        assert host.device.connects == 1
