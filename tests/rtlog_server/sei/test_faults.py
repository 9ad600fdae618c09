"""Everything that can go wrong on an SEI bus and its adapter, and how the encoders are read again."""

import fcntl
import itertools
import os
import random
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from patience import in_use, left_behind

from rtlog_server.devices import device
from rtlog_server.devices.sei import driver, protocol
from rtlog_server.devices.sei.emulator import SeiBusEmulator
from rtlog_server.messages import MISSING

COUNTS = 4096
GAP_NS = 200_000_000
BOTH = ("left_wheel", "right_wheel")
ADDRESSES = {"left_wheel": 0, "right_wheel": 5}

Start = Callable[..., Any]
Turning = Any  # the fixture of conftest.py
Counts = dict[int, int]


def wrong_readings(turning: Turning, readings: list[Any]) -> list[Any]:
    """Those with a wheel where it never was; after a gap it may have been anywhere, and anything is believed."""
    near = [after for before, after in itertools.pairwise(readings) if after.measured_ns - before.measured_ns < GAP_NS]
    return [reading for reading in near if not turning.were_at(reading, ADDRESSES)]


def note_steps(device: Any) -> list[str]:
    """What the driver does from now on, in its order: begin a round, ask an encoder, hand a reading over."""
    steps: list[str] = []

    def noting(name: str, say: Callable[..., str]) -> None:
        step = getattr(device, name)
        setattr(device, name, lambda *given: steps.append(say(*given)) or step(*given))

    noting("_poll_round", lambda *_: "round")
    noting("_ask", lambda _port, encoder, *_: encoder)
    noting("hand_over", lambda _: "reading")
    return steps


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
        bus.wait_for_message("cannot open the port: No such file")
        assert bus.device.collect(time.monotonic_ns()).state == MISSING
        decoys = take_terminal(first)
        emulator.replug()
        bus.wait_for_readings(1)
        assert link.readlink() != first
        for end in decoys:
            os.close(end)


def test_the_driver_may_start_before_the_adapter_is_there(
    link: Path, start: Start, counts: Counts, turning: Turning
) -> None:
    bus = start()
    bus.wait_for_message("No such file")
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
        muted = len(bus.readings)
        steps = note_steps(bus.device)
        bus.wait_for_readings(7)
        assert all(reading.names == ("right_wheel",) for reading in bus.readings[muted:])
        bus.wait_for_message("no answer from left_wheel")
        bus.wait_for(lambda: bus.device.diagnostics["left_wheel"] == "silent")
        rounds = " ".join(steps).split("round")  # in which nobody waits for the silent one
        assert sum("reading" in taken for taken in rounds) >= 6
        assert not any("left_wheel" in taken.split("reading")[0] for taken in rounds if "reading" in taken)
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
        bus.wait_for_message("no encoder answers")
        bus.wait_for(lambda: bus.device.collect(time.monotonic_ns()).state == MISSING)
        for address in counts:
            emulator.mute(address, muted=False)
        bus.wait_for_readings(1)


def test_corrupted_replies_are_asked_for_again(link: Path, start: Start, counts: Counts, turning: Turning) -> None:
    with SeiBusEmulator(link, counts, turning, echo=True) as emulator:
        bus = start()
        bus.wait_for_readings(3)
        emulator.garble(1)
        garbled_after = len(bus.readings)
        bus.wait_for(lambda: "position reply has 1 bytes, not 2" in bus.device.diagnostics["last garbled"])
        bus.wait_for(lambda: any(reading.names == BOTH for reading in bus.readings[garbled_after:]))
        assert int(bus.device.diagnostics["retries"]) >= 1
        assert int(bus.device.diagnostics["garbled"]) >= 1
        turning.looked_ns(bus.readings, ADDRESSES)


def test_a_corrupted_position_that_looks_like_one_never_comes_through(
    link: Path, start: Start, counts: Counts, turning: Turning
) -> None:
    with SeiBusEmulator(link, counts, turning) as emulator:
        bus = start()
        bus.wait_for_readings(4)
        emulator.bend(1)
        bus.wait_for(lambda: int(bus.device.diagnostics["retries"]) >= 1)
        bus.wait_for_readings(3)
    assert wrong_readings(turning, bus.readings) == []


def test_a_wheel_that_did_jump_is_believed_and_told_as_ambiguous(link: Path, start: Start, counts: Counts) -> None:
    moved = {0: 0, 5: 0}
    with SeiBusEmulator(link, counts, lambda address, _: 1000 + moved[address]):
        bus = start()
        bus.wait_for_readings(4)
        moved[0] = COUNTS // 3
        bus.wait_for(lambda: bus.readings[-1].counts[0] == 1000 + COUNTS // 3)
        assert any("left_wheel" in reading.doubtful for reading in bus.readings)
        bus.wait_for(lambda: int(bus.device.diagnostics["doubtful turns"]) >= 1)
        assert bus.device.diagnostics["last doubtful"].endswith(" s after the reading before")


def test_turns_lost_in_a_long_silence_are_told_as_ambiguous(
    link: Path, start: Start, counts: Counts, turning: Turning
) -> None:
    with SeiBusEmulator(link, counts, turning) as emulator:
        bus = start()
        bus.wait_for_readings(5)
        emulator.unplug()
        time.sleep(0.8)
        replugged = len(bus.readings)
        emulator.replug()
        bus.wait_for(lambda: {name for reading in bus.readings[replugged:] for name in reading.names} == set(BOTH))
        for name in BOTH:
            first = next(reading for reading in bus.readings[replugged:] if name in reading.names)
            assert name in first.doubtful
        bus.wait_for(lambda: bus.device.diagnostics["last doubtful"].endswith(" s after the reading before"))


def test_positions_beyond_the_turn_never_come_through(link: Path, start: Start) -> None:
    with SeiBusEmulator(link, {0: 65536, 5: COUNTS}, lambda address, _: {0: 50_000, 5: 7}[address]):
        bus = start()
        bus.wait_for_readings(3)
        assert all(reading.names == ("right_wheel",) for reading in bus.readings)
        told = "left_wheel: position 50000 lies beyond the 4096 counts"
        bus.wait_for(lambda: told in bus.device.diagnostics["last garbled"])


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
    # the same noise twice looks like a wheel that jumped
    assert len(wrong_readings(turning, bus.readings[noisy:quiet])) <= (quiet - noisy) // 2
    assert wrong_readings(turning, bus.readings[quiet:]) == []


def test_a_flood_is_told_and_survived(link: Path, start: Start, counts: Counts, turning: Turning) -> None:
    with SeiBusEmulator(link, counts, turning) as emulator:
        bus = start()
        bus.wait_for_readings(3)
        while not (bus.told("bytes") or "bytes" in bus.device.diagnostics["last garbled"]):
            emulator.babble(b"\x10\x02" * 500)
            time.sleep(0.001)
        bus.wait_for_readings(3)


@pytest.mark.parametrize("slow", [0, 5])
def test_an_encoder_that_lost_its_power_is_brought_back_to_the_fast_rate(
    link: Path, start: Start, counts: Counts, turning: Turning, slow: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(driver, "EMPTY_ROUNDS", 1000)  # the port stays open
    with SeiBusEmulator(link, counts, turning) as emulator:
        bus = start(baud=115200)
        bus.wait_for_readings(5)
        emulator.power_cycle(slow)
        cycled = len(bus.readings)
        bus.wait_for(lambda: any(len(reading.names) == 1 for reading in bus.readings[cycled:]))
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
        bus.wait_for_message("no encoder answers")
        bus.wait_for_readings(1)
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
        bus.wait_for_message("another process has it")
        os.close(other)
        bus.wait_for_readings(1)


def test_a_port_that_is_no_serial_port_is_told(tmp_path: Path, start: Start) -> None:
    file = tmp_path / "file"
    file.write_text("no port")
    bus = start(port=str(file))
    bus.wait_for_message(str(file))
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
        bus.wait_for_readings(1)
        before = in_use()
        for _ in range(8):
            connects = bus.device.connects
            emulator.unplug()
            emulator.replug()
            bus.wait_for(lambda: bus.device.connects > connects)  # noqa: B023
        bus.wait_for_readings(1)
        bus.wait_for(lambda: not left_behind(before))
