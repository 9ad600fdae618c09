"""The CAN encoders' driver against emulated encoders, over python-can's buses and an slcan adapter on a terminal."""

import itertools
import math
import os
import socket
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path

import can
import pytest

from hw_profiles.profile import CanBus, Encoder
from rtlog_server.devices.cia406 import protocol
from rtlog_server.devices.cia406.driver import Cia406Encoders
from rtlog_server.devices.cia406.emulated_encoder import Entry
from rtlog_server.devices.cia406.emulator import CanBusEmulator
from rtlog_server.devices.cia406.protocol import Frame
from rtlog_server.devices.device import TickGrid
from rtlog_server.devices.encoders import EncoderReading
from rtlog_server.messages import MISSING, OK

COUNTS = 4096
PERIOD_NS = 40_000_000
ENCODERS = (
    Encoder(name="left_wheel", role="left_wheel", address=5, wheel_radius_m=0.35),
    Encoder(name="right_wheel", role="right_wheel", address=9, wheel_radius_m=0.35, reversed=True),
)
TURNS_PER_S = {5: 2.3, 9: -1.7}
LATCH_S = {"sync": 0.003, "timer": 0.006}
BACK_NS = 2_000_000_000


def turning(node: int, at_ns: int) -> int:
    """Two wheels at a steady speed: counts over many turns."""
    return math.floor(at_ns * 1e-9 * TURNS_PER_S[node] * COUNTS)


def open_descriptors() -> int:
    return len(list(Path("/proc/self/fd").iterdir()))


class Host:
    """A running driver, collected at each tick."""

    def __init__(self, bus: CanBus, encoders: tuple[Encoder, ...] = ENCODERS) -> None:
        self.grid = TickGrid(time.monotonic_ns(), PERIOD_NS)
        self.device = Cia406Encoders("encoders", bus, encoders)
        self.device.start(self.grid)
        self.readings: list[EncoderReading] = []
        self.ages_s: list[float] = []

    def wait_for(self, condition: Callable[[], bool], timeout_s: float = 8.0) -> None:
        """Collect at each tick until the condition holds."""
        deadline_ns = time.monotonic_ns() + int(timeout_s * 1e9)
        while not condition():
            tick_ns = self.grid.next_after(time.monotonic_ns())
            assert tick_ns < deadline_ns, f"{self.device.message}; {self.device.diagnostics}"
            time.sleep(max(0, tick_ns - time.monotonic_ns()) * 1e-9)
            collected = self.device.collect(tick_ns)
            self.readings += collected.samples
            self.ages_s += [(tick_ns - sample.measured_ns) * 1e-9 for sample in collected.samples]

    def wait_for_readings(self, number: int) -> list[EncoderReading]:
        """The next so many."""
        first = len(self.readings)
        self.wait_for(lambda: len(self.readings) >= first + number)
        return self.readings[first:]

    def wait_for_message(self, part: str) -> None:
        self.wait_for(lambda: part in self.device.message)


@pytest.fixture
def virtual() -> CanBus:
    return CanBus(interface="virtual", channel=uuid.uuid4().hex)


@pytest.fixture
def slcan(tmp_path: Path) -> CanBus:
    return CanBus(interface="slcan", channel=str(tmp_path / "slcan"))


@pytest.fixture
def udp() -> CanBus:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("", 0))
        return CanBus(interface="udp_multicast", channel="239.74.163.2", udp_port=probe.getsockname()[1])


Start = Callable[..., Host]


@pytest.fixture
def start() -> Iterator[Start]:
    """Starts drivers and closes them at the end."""
    hosts: list[Host] = []

    def start_host(bus: CanBus, encoders: tuple[Encoder, ...] = ENCODERS) -> Host:
        hosts.append(Host(bus, encoders))
        return hosts[-1]

    yield start_host
    for host in hosts:
        host.device.close()


def emulate(bus: CanBus, position: Callable[[int, int], int] = turning) -> CanBusEmulator:
    return CanBusEmulator(bus, {5: COUNTS, 9: COUNTS}, position)


@pytest.mark.parametrize(("interface", "trigger"), [("udp", "sync"), ("slcan", "sync"), ("virtual", "timer")])
def test_positions_at_their_stamps_are_the_true_ones_over_many_turns(
    interface: str, trigger: str, request: pytest.FixtureRequest, start: Start
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
        errors_s += [error / abs(TURNS_PER_S[node]) for error in errors]
    assert sorted(errors_s)[len(errors_s) * 3 // 4] < LATCH_S[trigger]  # the rest: a machine with other work
    assert abs(readings[-1].counts[0] - readings[0].counts[0]) > 1.2 * COUNTS
    settled = sorted(host.ages_s[5:])
    assert 0.004 <= settled[len(settled) // 2] < 0.015  # taken just before the tick
    stamps = [reading.measured_ns for reading in readings]
    assert all(after - before > 0.4 * PERIOD_NS for before, after in itertools.pairwise(stamps))


def test_encoders_say_who_they_are(virtual: CanBus, start: Start) -> None:
    with emulate(virtual):
        host = start(virtual)
        host.wait_for(lambda: host.device.diagnostics.get("left_wheel") == "ok")
    assert host.device.identity["right_wheel"] == (
        "Emulated multi-turn encoder, node 9, vendor 0x2f1, product 0x406, revision 0x10002, serial number 83009"
    )


def test_only_what_differs_is_written(virtual: CanBus, start: Start) -> None:
    with emulate(virtual) as emulator:
        first = start(virtual)
        first.wait_for_readings(1)
        assert emulator.nodes[5].written == [(protocol.HEARTBEAT_MS, 200)]  # all else is a CiA 406 default
        first.device.close()
        second = start(virtual)
        second.wait_for_readings(1)
        assert emulator.nodes[5].written == [(protocol.HEARTBEAT_MS, 200)]


def test_an_encoder_is_scaled_and_turned_as_the_profile_says(virtual: CanBus, start: Start) -> None:
    left = Encoder(name="left_wheel", role="left_wheel", address=5, wheel_radius_m=0.35, counts_per_turn=1000)
    with CanBusEmulator(virtual, {5: 65536}, lambda _, at_ns: round(at_ns * 1e-9 * 0.5 * 65536)) as emulator:
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


def test_an_encoder_that_will_not_be_scaled_is_refused(virtual: CanBus, start: Start) -> None:
    with CanBusEmulator(virtual, {5: 8192, 9: COUNTS}, turning) as emulator:
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
    entries: list[int], written: bool, virtual: CanBus, start: Start
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


def test_another_kind_of_device_under_an_id_is_named_and_let_alone(virtual: CanBus, start: Start) -> None:
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


def test_an_encoder_of_another_vendor_is_named(virtual: CanBus, start: Start) -> None:
    ours = CanBus(interface="virtual", channel=virtual.channel, vendor_id=0x2F1)
    other = CanBus(interface="virtual", channel=virtual.channel, vendor_id=0x77)
    with emulate(virtual):
        start(ours).wait_for_readings(1)
        host = start(other)
        host.wait_for_message("right_wheel (node 9): is of vendor 0x2f1; encoder_bus.vendor_id is 0x77")
        assert not host.device.connected


def test_an_encoder_that_falls_silent_costs_the_other_nothing_and_is_back_in_two_seconds(
    virtual: CanBus, start: Start
) -> None:
    with emulate(virtual) as emulator:
        host = start(virtual)
        host.wait_for_readings(3)
        emulator.mute(5)
        host.wait_for(lambda: host.readings[-1].names == ("right_wheel",))
        host.wait_for_message("left_wheel (node 5): ")
        host.ages_s.clear()
        assert {reading.names for reading in host.wait_for_readings(9)} == {("right_wheel",)}
        assert sorted(host.ages_s)[5] < 0.015
        emulator.mute(5, muted=False)
        back_ns = time.monotonic_ns()
        host.wait_for(lambda: host.readings[-1].names == ("left_wheel", "right_wheel"))
        assert host.readings[-1].complete_ns - back_ns < BACK_NS
        assert host.readings[-1].doubtful == ()  # it counts turns itself
        host.wait_for(lambda: host.device.message == "connected")
        assert host.device.connects == 1


def test_turns_that_a_single_turn_encoder_may_have_missed_are_doubtful(virtual: CanBus, start: Start) -> None:
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
        emulator.mute(5, muted=False)
        host.wait_for(lambda: len(host.readings[-1].names) == 2)
        first = next(reading for reading in host.readings if reading.doubtful)
        assert first.doubtful == ("left_wheel",)


def test_a_bus_that_fell_silent_is_opened_anew_until_it_answers(udp: CanBus, start: Start) -> None:
    with emulate(udp) as emulator:
        host = start(udp)
        host.wait_for_readings(3)
        for node in (5, 9):
            emulator.mute(node)
        host.wait_for(lambda: not host.device.connected)
        assert host.device.collect(time.monotonic_ns()).state == MISSING
        host.wait_for_message("udp_multicast:239.74.163.2: left_wheel (node 5): no answer")
        for node in (5, 9):
            emulator.mute(node, muted=False)
        back_ns = time.monotonic_ns()
        assert host.wait_for_readings(1)[0].complete_ns - back_ns < BACK_NS


def test_an_encoder_that_restarts_is_configured_again_while_the_other_goes_on(virtual: CanBus, start: Start) -> None:
    with emulate(virtual) as emulator:
        host = start(virtual)
        host.wait_for_readings(3)
        emulator.power_cycle(5)
        restarted_ns = time.monotonic_ns()
        host.wait_for(lambda: host.device.diagnostics["restarts"] == "1")
        host.wait_for(lambda: len(host.readings[-1].names) == 2)
        assert host.readings[-1].complete_ns - restarted_ns < BACK_NS
        assert emulator.nodes[5].written == [(protocol.HEARTBEAT_MS, 200)] * 2
        assert all("right_wheel" in reading.names for reading in host.readings)
        assert host.device.connects == 1


@pytest.mark.parametrize("command", [protocol.STOP, protocol.ENTER_PRE_OPERATIONAL])
def test_an_encoder_that_somebody_stopped_is_started_again(command: int, virtual: CanBus, start: Start) -> None:
    with emulate(virtual) as emulator:
        host = start(virtual)
        host.wait_for_readings(3)
        emulator.nodes[5].take(protocol.nmt_command(command, 5), time.monotonic_ns())
        host.wait_for(lambda: emulator.nodes[5].state == protocol.OPERATIONAL)
        host.wait_for(lambda: any(len(reading.names) == 1 for reading in host.readings))
        assert len(host.wait_for_readings(2)[-1].names) == 2


def test_a_pdo_that_somebody_switched_off_is_switched_on_again(virtual: CanBus, start: Start) -> None:
    with emulate(virtual) as emulator:
        host = start(virtual)
        host.wait_for_readings(3)
        emulator.nodes[5].objects[(0x1801, protocol.COB_ID)].value = 0x285 | protocol.PDO_DISABLED
        host.wait_for(lambda: host.readings[-1].names == ("right_wheel",))
        host.wait_for(lambda: len(host.readings[-1].names) == 2)


def test_an_emergency_is_told_until_it_is_over(virtual: CanBus, start: Start) -> None:
    with emulate(virtual) as emulator:
        host = start(virtual)
        host.wait_for_readings(1)
        emulator.emergency(9, 0x4210, vendor=b"\x01\x02")
        told = "emergency 4210h, temperature, error register 81h, vendor's 01 02 00 00 00"
        host.wait_for(lambda: host.device.message == f"right_wheel: {told}")
        assert host.device.diagnostics["right_wheel"] == told
        assert len(host.wait_for_readings(2)[-1].names) == 2
        emulator.emergency(9, 0)
        host.wait_for(lambda: host.device.message == "connected")


def test_a_second_node_with_the_same_id_is_noticed(virtual: CanBus, start: Start) -> None:
    with emulate(virtual) as emulator:
        host = start(virtual)
        host.wait_for_readings(2)
        with can.Bus(interface="virtual", channel=virtual.channel) as second:
            while "left_wheel: two nodes answer to its id" not in host.device.message:
                frame = second.recv(5.0)
                assert frame is not None
                if frame.arbitration_id == protocol.SYNC:
                    second.send(can.Message(arbitration_id=0x285, data=b"\x07\0\0\0", is_extended_id=False))
        host.wait_for(lambda: host.device.message == "connected")
        assert emulator.nodes[5].state == protocol.OPERATIONAL


def test_what_an_encoder_complains_of_at_the_start_is_told(virtual: CanBus, start: Start) -> None:
    with emulate(virtual) as emulator:
        emulator.wait_until_done()
        emulator.nodes[5].objects[protocol.ALARMS].value = 1
        host = start(virtual)
        host.wait_for(lambda: host.device.diagnostics.get("left_wheel") == "alarms 01h")


def test_an_adapter_that_comes_late_is_pulled_and_put_back_is_read_within_two_seconds(
    slcan: CanBus, start: Start
) -> None:
    host = start(slcan)
    host.wait_for_message("cannot open the CAN interface: No such file or directory")
    with emulate(slcan) as emulator:
        plugged_ns = time.monotonic_ns()
        assert host.wait_for_readings(3)[0].complete_ns - plugged_ns < BACK_NS
        emulator.unplug()
        host.wait_for(lambda: not host.device.connected)
        host.wait_for_message("No such file or directory")
        emulator.replug()
        plugged_ns = time.monotonic_ns()
        assert host.wait_for_readings(1)[0].complete_ns - plugged_ns < BACK_NS
        assert host.device.connects == 2


def test_bus_off_is_named_and_survived(virtual: CanBus, start: Start) -> None:
    with emulate(virtual), can.Bus(interface="virtual", channel=virtual.channel) as kernel:
        host = start(virtual)
        host.wait_for_readings(1)
        kernel.send(can.Message(arbitration_id=0x40, is_error_frame=True, is_extended_id=False, data=bytes(8)))
        host.wait_for_message("bus-off")
        host.wait_for(lambda: host.device.connects == 2)
        host.wait_for_readings(1)


def test_an_interface_that_is_not_there_is_told(start: Start) -> None:
    host = start(CanBus(channel="rtlog-none0"))
    host.wait_for_message("socketcan:rtlog-none0: cannot open the CAN interface: ")
    assert "\n" not in host.device.message


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


def test_garbage_and_a_flood_of_foreign_frames_cost_no_reading(virtual: CanBus, start: Start) -> None:
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
        partial = [reading for reading in host.readings if len(reading.names) < 2]
        assert len(partial) <= 2  # a reply that a busy machine held up for half a tick
        assert host.device.connects == 1


def test_noise_of_an_slcan_adapter_is_waded_through(slcan: CanBus, start: Start) -> None:
    with emulate(slcan) as emulator:
        host = start(slcan)
        host.wait_for_readings(2)
        for noise in (b"\xff\xfe\x80\r", b"t28", b"txyz!\r", b"t285F00\r", b"t\r", b"z" * 3000, b"z" * 3000, b"\r\r"):
            emulator.adapter_noise(noise)
            host.wait_for_readings(2)
        assert int(host.device.diagnostics["noise"]) >= 3
        assert host.device.connects == 1


def test_noise_on_the_multicast_group_is_waded_through(udp: CanBus, start: Start) -> None:
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


def test_steering_is_signed_about_its_zero(virtual: CanBus, start: Start) -> None:
    steering = Encoder(name="steering", role="steering", address=7, zero_deg=355.0)
    with CanBusEmulator(virtual, {7: COUNTS}, lambda _node, _at_ns: 3 * COUNTS + round(10 / 360 * COUNTS)):
        reading = start(virtual, (steering,)).wait_for_readings(1)[0]
    assert reading.positions_rad == (pytest.approx(math.radians(15.0), abs=2e-3),)


@pytest.mark.parametrize("interface", ["udp", "slcan", "virtual"])
def test_reconnects_leak_neither_threads_nor_descriptors(
    interface: str, request: pytest.FixtureRequest, start: Start
) -> None:
    """A quick share; tests/hil has a thousand."""
    bus = request.getfixturevalue(interface)
    with emulate(bus):
        device = Cia406Encoders("encoders", bus, ENCODERS)
        device.grid = TickGrid(time.monotonic_ns(), PERIOD_NS)
        device.connect()
        device.disconnect()
        before = threading.active_count(), open_descriptors()
        for _ in range(8):
            device.connect()
            device.disconnect()
        assert (threading.active_count(), open_descriptors()) == before
