"""The encoders' driver against emulated encoders, over a real pseudo-terminal."""

import fcntl
import itertools
import math
import os
import statistics
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from hw_profiles.profile import Encoder, SeiBus
from rtlog_server.devices.device import TickGrid
from rtlog_server.devices.encoders import EncoderReading
from rtlog_server.devices.sei import protocol
from rtlog_server.devices.sei.driver import SeiEncoders
from rtlog_server.devices.sei.emulator import SeiBusEmulator
from rtlog_server.messages import MISSING, OK

COUNTS = 4096
PERIOD_NS = 33_300_000  # no multiple of the 4 ms in which an encoder looks at its disc
ENCODERS = (
    Encoder(name="left_wheel", role="left_wheel", address=0, wheel_radius_m=0.35),
    Encoder(name="right_wheel", role="right_wheel", address=5, wheel_radius_m=0.35, reversed=True),
)
TURNS_PER_S = {0: 2.3, 5: -1.7}
LATCH_S = 0.006  # half the time between both latches, the look at the disc each 4 ms, and a busy machine


def turning(address: int, at_ns: int) -> int:
    """Two wheels at a steady speed: counts over many turns."""
    return math.floor(at_ns * 1e-9 * TURNS_PER_S[address] * COUNTS)


class Bus:
    """An emulator and a running driver."""

    def __init__(self, link: Path, bus: SeiBus | None = None, encoders: tuple[Encoder, ...] = ENCODERS) -> None:
        self.grid = TickGrid(time.monotonic_ns(), PERIOD_NS)
        self.device = SeiEncoders("encoders", bus or SeiBus(port=str(link)), encoders)
        self.device.start(self.grid)
        self.readings: list[EncoderReading] = []
        self.ages_s: list[float] = []

    def wait_for(self, condition: Callable[[], bool], timeout_s: float = 4.0) -> None:
        """Collect at each tick until the condition holds."""
        deadline_ns = time.monotonic_ns() + int(timeout_s * 1e9)
        while not condition():
            tick_ns = self.grid.next_after(time.monotonic_ns())
            assert tick_ns < deadline_ns, f"{self.device.message}; {self.device.diagnostics}"
            time.sleep(max(0, tick_ns - time.monotonic_ns()) * 1e-9)
            collected = self.device.collect(tick_ns)
            self.readings += collected.samples
            self.ages_s += [(tick_ns - sample.measured_ns) * 1e-9 for sample in collected.samples]

    def wait_for_readings(self, number: int) -> None:
        wanted = len(self.readings) + number
        self.wait_for(lambda: len(self.readings) >= wanted)


@pytest.fixture
def link(tmp_path: Path) -> Path:
    return tmp_path / "sei"


@pytest.fixture
def running() -> Iterator[list[SeiEncoders]]:
    """Drivers to close at the end."""
    devices: list[SeiEncoders] = []
    yield devices
    for device in devices:
        device.close()


@pytest.mark.parametrize("echo", [False, True])
@pytest.mark.parametrize("turns", ["single", "multi"])
def test_positions_at_their_stamps_are_the_true_ones_over_many_turns(
    link: Path, running: list[SeiEncoders], echo: bool, turns: str
) -> None:
    with SeiBusEmulator(link, {0: COUNTS, 5: COUNTS}, turning, echo=echo, multi_turn=turns == "multi"):
        bus = Bus(link, SeiBus(port=str(link), turns=turns))
        running.append(bus.device)
        bus.wait_for_readings(24)
    first = bus.readings[0]
    offsets = [round((first.counts[i] - turning(a, first.measured_ns)) / COUNTS) * COUNTS for i, a in enumerate((0, 5))]
    errors_s = []
    for reading in bus.readings:
        assert reading.names == ("left_wheel", "right_wheel")
        assert reading.doubtful == ()
        for index, address in enumerate((0, 5)):
            error = reading.counts[index] - turning(address, reading.measured_ns) - offsets[index]
            assert abs(error) < COUNTS / 4  # no turn too many or too few
            errors_s.append(error / (TURNS_PER_S[address] * COUNTS))
        assert reading.positions_rad[0] == pytest.approx(2 * math.pi * reading.counts[0] / COUNTS)
        assert reading.positions_rad[1] == pytest.approx(-2 * math.pi * reading.counts[1] / COUNTS)
    assert sorted(map(abs, errors_s))[len(errors_s) * 3 // 4] < LATCH_S  # the rest: a machine with other work
    assert abs(statistics.median(errors_s[0::2]) + statistics.median(errors_s[1::2])) / 2 < 0.0012  # no bias
    assert abs(bus.readings[-1].counts[0] - first.counts[0]) > 1.5 * COUNTS
    assert bus.device.diagnostics["echo"] == ("yes" if echo else "no")
    assert bus.device.identity["right_wheel"].endswith(f"address 5, serial number 61005, {turns}-turn, ok")


def test_each_tick_has_a_reading_taken_just_before_it(link: Path, running: list[SeiEncoders]) -> None:
    with SeiBusEmulator(link, {0: COUNTS, 5: COUNTS}, turning):
        bus = Bus(link)
        running.append(bus.device)
        bus.wait_for_readings(30)
    settled = sorted(bus.ages_s[5:])
    assert settled[len(settled) // 2] < 0.015
    assert settled[0] > 0.004
    stamps = [reading.measured_ns for reading in bus.readings]
    assert all(after - before > 0.4 * PERIOD_NS for before, after in itertools.pairwise(stamps))


def test_steering_is_signed_about_its_zero(link: Path, running: list[SeiEncoders]) -> None:
    steering = Encoder(name="steering", role="steering", address=1, zero_deg=355.0)
    with SeiBusEmulator(link, {1: COUNTS}, lambda _address, _at_ns: round(10 / 360 * COUNTS)):
        bus = Bus(link, encoders=(steering,))
        running.append(bus.device)
        bus.wait_for_readings(1)
    assert bus.readings[0].positions_rad == (pytest.approx(math.radians(15.0), abs=2e-3),)


def test_an_adapter_that_is_pulled_and_put_back_is_read_again_within_two_seconds(
    link: Path, running: list[SeiEncoders]
) -> None:
    with SeiBusEmulator(link, {0: COUNTS, 5: COUNTS}, turning) as emulator:
        bus = Bus(link)
        running.append(bus.device)
        bus.wait_for_readings(3)
        emulator.unplug()
        pulled_s = time.monotonic()
        assert not link.is_symlink()
        bus.wait_for(lambda: not bus.device.connected)
        bus.wait_for(lambda: "cannot open the port" in bus.device.message)
        assert bus.device.collect(time.monotonic_ns()).state == MISSING
        bus.wait_for(lambda: time.monotonic() - pulled_s > 0.8)  # so long that the wheels' speed tells no more
        emulator.replug()
        back_ns = time.monotonic_ns()
        bus.wait_for_readings(1)
        assert time.monotonic_ns() - back_ns < 2_000_000_000
        assert bus.device.collect(time.monotonic_ns()).state == OK
        # Nobody knows how often the wheels turned meanwhile, and that is said.
        assert set(bus.readings[-1].doubtful) == {"left_wheel", "right_wheel"}
        assert bus.device.connects == 2


def test_the_driver_may_start_before_the_adapter_is_there(link: Path, running: list[SeiEncoders]) -> None:
    bus = Bus(link)
    running.append(bus.device)
    bus.wait_for(lambda: "No such file" in bus.device.message)
    with SeiBusEmulator(link, {0: COUNTS, 5: COUNTS}, turning):
        bus.wait_for_readings(2)


def test_a_silent_encoder_is_named_and_missed_while_the_other_goes_on(link: Path, running: list[SeiEncoders]) -> None:
    with SeiBusEmulator(link, {0: COUNTS, 5: COUNTS}, turning) as emulator:
        bus = Bus(link)
        running.append(bus.device)
        bus.wait_for_readings(3)
        emulator.mute(0)
        bus.wait_for(lambda: bus.readings[-1].names == ("right_wheel",))
        bus.ages_s.clear()
        bus.wait_for_readings(5)
        assert all(reading.names == ("right_wheel",) for reading in bus.readings[-5:])
        assert bus.device.message == "no answer from left_wheel"
        assert bus.device.diagnostics["left_wheel"] == "silent"
        assert sorted(bus.ages_s)[2] < 0.015  # the silent one costs the other no time
        emulator.mute(0, muted=False)
        bus.wait_for(lambda: bus.readings[-1].names == ("left_wheel", "right_wheel"))
        bus.wait_for(lambda: bus.device.message == "connected")


def test_a_bus_that_fell_silent_is_opened_anew_until_it_answers(link: Path, running: list[SeiEncoders]) -> None:
    with SeiBusEmulator(link, {0: COUNTS, 5: COUNTS}, turning) as emulator:
        bus = Bus(link)
        running.append(bus.device)
        bus.wait_for_readings(3)
        for address in (0, 5):
            emulator.mute(address)
        bus.wait_for(lambda: bus.device.message.endswith("no encoder answers"))
        assert not bus.device.connected
        for address in (0, 5):
            emulator.mute(address, muted=False)
        bus.wait_for_readings(1)


def test_corrupted_replies_are_asked_for_again(link: Path, running: list[SeiEncoders]) -> None:
    with SeiBusEmulator(link, {0: COUNTS, 5: COUNTS}, turning, echo=True) as emulator:
        bus = Bus(link)
        running.append(bus.device)
        bus.wait_for_readings(3)
        emulator.garble(1)
        bus.wait_for(lambda: bus.device.diagnostics["garbled"] == "1")
        bus.wait_for_readings(3)
        assert all(len(reading.names) == 2 for reading in bus.readings)
        assert bus.device.diagnostics["retries"] == "1"
        assert "position reply has 1 bytes, not 2" in bus.device.diagnostics["last garbled"]
        assert not any(reading.doubtful for reading in bus.readings)


def test_positions_beyond_the_turn_never_come_through(link: Path, running: list[SeiEncoders]) -> None:
    with SeiBusEmulator(link, {0: 65536, 5: COUNTS}, lambda address, _: {0: 50_000, 5: 7}[address]):
        bus = Bus(link)
        running.append(bus.device)
        bus.wait_for_readings(3)
        assert all(reading.names == ("right_wheel",) for reading in bus.readings)
        assert "left_wheel: position 50000 lies beyond the 4096 counts" in bus.device.diagnostics["last garbled"]


def test_a_profile_with_the_wrong_turns_or_echo_is_told(link: Path, running: list[SeiEncoders]) -> None:
    with SeiBusEmulator(link, {0: COUNTS, 5: COUNTS}, turning, multi_turn=True):
        wrong_turns = Bus(link)
        running.append(wrong_turns.device)
        wrong_turns.wait_for(lambda: "encoder_bus.turns = 'single'" in wrong_turns.device.message)
        wrong_turns.device.close()
        wrong_echo = Bus(link, SeiBus(port=str(link), turns="multi", echo="yes"))
        running.append(wrong_echo.device)
        wrong_echo.wait_for(lambda: "encoder_bus.echo is 'yes'" in wrong_echo.device.message)


def test_a_position_that_begins_like_its_request_is_no_echo(link: Path, running: list[SeiEncoders]) -> None:
    wide = Encoder(name="steering", role="steering", address=0, counts_per_turn=65536)
    with SeiBusEmulator(link, {0: 65536}, lambda _address, _at_ns: 0x10AB):
        bus = Bus(link, encoders=(wide,))
        running.append(bus.device)
        bus.wait_for_readings(2)
        assert bus.device.diagnostics["echo"] == "no"
        assert {reading.counts for reading in bus.readings} == {(0x10AB,)}


def test_an_encoder_that_lost_its_power_is_brought_back_to_the_fast_rate(
    link: Path, running: list[SeiEncoders]
) -> None:
    with SeiBusEmulator(link, {0: COUNTS, 5: COUNTS}, turning) as emulator:
        bus = Bus(link, SeiBus(port=str(link), baud=115200))
        running.append(bus.device)
        bus.wait_for_readings(5)
        assert min(bus.ages_s) < 0.009  # a round takes 1 ms instead of 7
        emulator.power_cycle(5)
        bus.wait_for(lambda: bus.readings[-1].names == ("left_wheel",))
        bus.wait_for(lambda: len(bus.readings[-1].names) == 2)
        assert bus.device.connects == 1


def test_encoders_that_were_left_at_the_fast_rate_are_brought_back(link: Path, running: list[SeiEncoders]) -> None:
    with SeiBusEmulator(link, {0: COUNTS, 5: COUNTS}, turning):
        fast = Bus(link, SeiBus(port=str(link), baud=115200))
        running.append(fast.device)
        fast.wait_for_readings(1)
        fast.device.close()
        slow = Bus(link, SeiBus(port=str(link), baud=protocol.POWER_UP_BAUD))
        running.append(slow.device)
        slow.wait_for_readings(1)


def test_a_port_that_another_process_reads_is_told(link: Path, running: list[SeiEncoders]) -> None:
    with SeiBusEmulator(link, {0: COUNTS, 5: COUNTS}, turning):
        other = os.open(link, os.O_RDWR | os.O_NOCTTY)
        fcntl.flock(other, fcntl.LOCK_EX)
        bus = Bus(link)
        running.append(bus.device)
        bus.wait_for(lambda: "another process has it" in bus.device.message)
        os.close(other)
        bus.wait_for_readings(1)


def test_a_port_that_is_no_serial_port_is_told(tmp_path: Path, running: list[SeiEncoders]) -> None:
    file = tmp_path / "file"
    file.write_text("no port")
    bus = Bus(file)
    running.append(bus.device)
    bus.wait_for(lambda: str(file) in bus.device.message)
    assert "\n" not in bus.device.message
    assert file.read_text() == "no port"


def test_the_emulator_puts_its_link_over_no_file(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("mine")
    with pytest.raises(FileExistsError, match="no symbolic link"):
        SeiBusEmulator(file, {0: COUNTS}, turning)
    assert file.read_text() == "mine"
