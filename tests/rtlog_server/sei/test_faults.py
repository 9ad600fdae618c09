"""Everything that can go wrong on an SEI bus and its adapter, and how soon the encoders are read again."""

import fcntl
import os
import random
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rtlog_server.devices import device
from rtlog_server.devices.sei import protocol
from rtlog_server.devices.sei.emulator import SeiBusEmulator
from rtlog_server.messages import MISSING

COUNTS = 4096
RETURN_S = 2.0
BOTH = ("left_wheel", "right_wheel")

Start = Callable[..., Any]
Turning = Callable[[int, int], int]
Counts = dict[int, int]


def count_wrong(turning: Turning, readings: list[Any]) -> int:
    """How many positions are a quarter of a turn or more off from where the wheel truly was."""
    wrong = 0
    for reading in readings:
        for index, name in enumerate(reading.names):
            error = (reading.counts[index] - turning(5 * BOTH.index(name), reading.measured_ns)) % COUNTS
            wrong += min(error, COUNTS - error) >= COUNTS // 4
    return wrong


def wait_until_back(bus: Any, readings: int = 1) -> float:
    """How long it takes until there are readings again, in s."""
    began_s = time.monotonic()
    bus.wait_for_readings(readings)
    return time.monotonic() - began_s


def take_terminal(name: Path) -> list[int]:
    """Open terminals until the one of that name is taken, by us or another process."""
    ends: list[int] = []
    while not name.exists():
        ends += os.openpty()
    return ends


def test_an_adapter_that_is_pulled_comes_back_as_another_terminal(
    link: Path, start: Start, counts: Counts, turning: Turning
) -> None:
    with SeiBusEmulator(link, counts, turning) as emulator:
        bus = start()
        bus.wait_for_readings(3)
        first = link.readlink()
        emulator.unplug()
        bus.wait_for(lambda: "cannot open the port: No such file" in bus.device.message)
        assert bus.device.collect(time.monotonic_ns()).state == MISSING
        decoys = take_terminal(first)
        time.sleep(0.5)
        emulator.replug()
        assert wait_until_back(bus) < RETURN_S
        assert link.readlink() != first
        for end in decoys:
            os.close(end)


def test_the_driver_may_start_before_the_adapter_is_there(
    link: Path, start: Start, counts: Counts, turning: Turning
) -> None:
    bus = start()
    bus.wait_for(lambda: "No such file" in bus.device.message)
    with SeiBusEmulator(link, counts, turning):
        bus.wait_for_readings(2)


def test_a_silent_encoder_is_named_and_missed_while_the_other_goes_on(
    link: Path, start: Start, counts: Counts, turning: Turning
) -> None:
    with SeiBusEmulator(link, counts, turning) as emulator:
        bus = start()
        bus.wait_for_readings(3)
        emulator.mute(0)
        bus.wait_for(lambda: bus.readings[-1].names == ("right_wheel",))
        bus.ages_s.clear()
        bus.wait_for_readings(7)
        assert all(reading.names == ("right_wheel",) for reading in bus.readings[-7:])
        assert bus.device.message == "no answer from left_wheel"
        assert bus.device.diagnostics["left_wheel"] == "silent"
        assert sorted(bus.ages_s)[1] < 0.025  # the silent one costs the other no time; a time-out is 0.03 s
        emulator.mute(0, muted=False)
        bus.wait_for(lambda: bus.readings[-1].names == BOTH)
        bus.wait_for(lambda: bus.device.message == "connected")


def test_a_bus_that_fell_silent_is_opened_anew_until_it_answers(
    link: Path, start: Start, counts: Counts, turning: Turning
) -> None:
    with SeiBusEmulator(link, counts, turning) as emulator:
        bus = start()
        bus.wait_for_readings(3)
        for address in counts:
            emulator.mute(address)
        bus.wait_for(lambda: bus.device.message.endswith("no encoder answers"))
        assert not bus.device.connected
        for address in counts:
            emulator.mute(address, muted=False)
        assert wait_until_back(bus) < RETURN_S


def test_corrupted_replies_are_asked_for_again(link: Path, start: Start, counts: Counts, turning: Turning) -> None:
    with SeiBusEmulator(link, counts, turning, echo=True) as emulator:
        bus = start()
        bus.wait_for_readings(3)
        emulator.garble(1)
        garbled_after = len(bus.readings)
        bus.wait_for(lambda: bus.device.diagnostics["garbled"] == "1")
        bus.wait_for_readings(3)
        assert any(reading.names == BOTH for reading in bus.readings[garbled_after : garbled_after + 3])
        assert int(bus.device.diagnostics["retries"]) >= 1
        assert "position reply has 1 bytes, not 2" in bus.device.diagnostics["last garbled"]
        assert not any(reading.doubtful for reading in bus.readings)


def test_a_corrupted_position_that_looks_like_one_never_comes_through(
    link: Path, start: Start, counts: Counts, turning: Turning
) -> None:
    with SeiBusEmulator(link, counts, turning) as emulator:
        bus = start()
        bus.wait_for_readings(4)
        emulator.bend(1)
        bus.wait_for(lambda: int(bus.device.diagnostics["retries"]) >= 1)
        bus.wait_for_readings(3)
    assert count_wrong(turning, bus.readings) == 0


def test_a_wheel_that_did_jump_is_believed_and_told_as_ambiguous(link: Path, start: Start, counts: Counts) -> None:
    moved = {0: 0, 5: 0}
    with SeiBusEmulator(link, counts, lambda address, _: 1000 + moved[address]):
        bus = start()
        bus.wait_for_readings(4)
        moved[0] = COUNTS // 3
        bus.wait_for(lambda: bus.readings[-1].counts[0] == 1000 + COUNTS // 3)
        assert any(reading.doubtful == ("left_wheel",) for reading in bus.readings)
        bus.wait_for(lambda: int(bus.device.diagnostics["doubtful turns"]) >= 1)
        assert bus.device.diagnostics["last doubtful"].startswith("left_wheel, 0.")


def test_turns_lost_in_a_long_silence_are_told_as_ambiguous(
    link: Path, start: Start, counts: Counts, turning: Turning
) -> None:
    with SeiBusEmulator(link, counts, turning) as emulator:
        bus = start()
        bus.wait_for_readings(5)
        emulator.unplug()
        time.sleep(0.8)
        emulator.replug()
        bus.wait_for_readings(3)
        doubtful = [reading.doubtful for reading in bus.readings if reading.doubtful]
        assert doubtful == [BOTH]
        assert bus.device.diagnostics["last doubtful"].startswith("left_wheel, right_wheel, ")


def test_positions_beyond_the_turn_never_come_through(link: Path, start: Start) -> None:
    with SeiBusEmulator(link, {0: 65536, 5: COUNTS}, lambda address, _: {0: 50_000, 5: 7}[address]):
        bus = start()
        bus.wait_for_readings(3)
        assert all(reading.names == ("right_wheel",) for reading in bus.readings)
        assert "left_wheel: position 50000 lies beyond the 4096 counts" in bus.device.diagnostics["last garbled"]


def test_noise_on_the_bus_costs_readings_while_it_lasts(
    link: Path, start: Start, counts: Counts, turning: Turning
) -> None:
    with SeiBusEmulator(link, counts, turning) as emulator:
        bus = start()
        bus.wait_for_readings(4)
        noisy = len(bus.readings)
        noise = random.Random(1)
        for _ in range(40):
            emulator.babble(noise.randbytes(4))
            time.sleep(0.007)
        quiet = len(bus.readings) + 3
        bus.wait_for_readings(8)
        bus.wait_for(lambda: bus.readings[-1].names == BOTH)
    assert count_wrong(turning, bus.readings[noisy:quiet]) <= 3  # the same noise twice looks like a wheel that jumped
    assert count_wrong(turning, bus.readings[quiet:]) == 0


def test_a_flood_is_told_and_survived(link: Path, start: Start, counts: Counts, turning: Turning) -> None:
    with SeiBusEmulator(link, counts, turning) as emulator:
        bus = start()
        bus.wait_for_readings(3)
        end_s = time.monotonic() + 0.5
        while time.monotonic() < end_s:
            emulator.babble(b"\x10\x02" * 500)
            time.sleep(0.001)
        assert "bytes" in bus.device.message + bus.device.diagnostics["last garbled"]
        assert wait_until_back(bus, 3) < RETURN_S


@pytest.mark.parametrize("slow", [0, 5])
def test_an_encoder_that_lost_its_power_is_brought_back_to_the_fast_rate(
    link: Path, start: Start, counts: Counts, turning: Turning, slow: int
) -> None:
    with SeiBusEmulator(link, counts, turning) as emulator:
        bus = start(baud=115200)
        bus.wait_for_readings(5)
        emulator.power_cycle(slow)
        bus.wait_for(lambda: len(bus.readings[-1].names) == 1)
        bus.wait_for(lambda: len(bus.readings[-1].names) == 2)
        assert bus.device.connects == 1


def test_all_encoders_that_lost_their_power_are_brought_back_to_the_fast_rate(
    link: Path, start: Start, counts: Counts, turning: Turning
) -> None:
    with SeiBusEmulator(link, counts, turning) as emulator:
        bus = start(baud=115200)
        bus.wait_for_readings(2)
        for address in counts:
            emulator.power_cycle(address)
        bus.wait_for(lambda: bus.device.message.endswith("no encoder answers") or bus.device.connects > 1)
        assert wait_until_back(bus) < RETURN_S
        bus.wait_for(lambda: bus.readings[-1].names == BOTH)


@pytest.mark.parametrize("left_fast", [{0, 5}, {5}])
def test_encoders_that_were_left_at_the_fast_rate_are_brought_back(
    link: Path, start: Start, counts: Counts, turning: Turning, left_fast: set[int]
) -> None:
    with SeiBusEmulator(link, counts, turning) as emulator:
        fast = start(baud=115200)
        fast.wait_for_readings(1)
        fast.device.close()
        for address in set(counts) - left_fast:
            emulator.power_cycle(address)
        slow = start(baud=protocol.POWER_UP_BAUD)
        slow.wait_for(lambda: bool(slow.readings) and slow.readings[-1].names == BOTH)


def test_a_port_that_another_process_reads_is_told(link: Path, start: Start, counts: Counts, turning: Turning) -> None:
    with SeiBusEmulator(link, counts, turning):
        other = os.open(link, os.O_RDWR | os.O_NOCTTY)
        fcntl.flock(other, fcntl.LOCK_EX)
        bus = start()
        bus.wait_for(lambda: "another process has it" in bus.device.message)
        os.close(other)
        bus.wait_for_readings(1)


def test_a_port_that_is_no_serial_port_is_told(tmp_path: Path, start: Start) -> None:
    file = tmp_path / "file"
    file.write_text("no port")
    bus = start(port=str(file))
    bus.wait_for(lambda: str(file) in bus.device.message)
    assert "\n" not in bus.device.message
    assert file.read_text() == "no port"


def test_the_emulator_puts_its_link_over_no_file(tmp_path: Path, turning: Turning) -> None:
    file = tmp_path / "file"
    file.write_text("mine")
    with pytest.raises(FileExistsError, match="no symbolic link"):
        SeiBusEmulator(file, {0: COUNTS}, turning)
    assert file.read_text() == "mine"


def test_reconnects_leak_neither_threads_nor_descriptors(
    link: Path, start: Start, counts: Counts, turning: Turning, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(device, "RETRY_FIRST_S", 0.001)
    with SeiBusEmulator(link, counts, turning) as emulator:
        bus = start(baud=115200)
        threads, descriptors = [], []
        for number in range(9):
            bus.wait_for(lambda: bus.device.connects > number and bus.device.connected)  # noqa: B023
            threads.append(threading.active_count())
            descriptors.append(len(list(Path("/proc/self/fd").iterdir())))
            emulator.unplug()
            emulator.replug()
    assert max(threads[4:]) <= max(threads[:4])
    assert max(descriptors[4:]) <= max(descriptors[:4])
