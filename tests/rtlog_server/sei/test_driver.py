"""The encoders' driver against emulated encoders that do as they should."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from hw_profiles.profile import Encoder
from rtlog_server.devices.sei import protocol
from rtlog_server.devices.sei.emulator import SeiBusEmulator
from rtlog_server.devices.sei.round_timing import MAX_LATE_NS, SAFETY_NS, RoundTiming

COUNTS = 4096
ADDRESSES = {"left_wheel": 0, "right_wheel": 5}

Start = Callable[..., Any]
Turning = Any  # the fixture of conftest.py
Counts = dict[int, int]


@pytest.mark.parametrize(
    ("echo", "turns", "strobe"),
    [(False, "single", False), (True, "multi", False), (True, "single", True), (False, "multi", True)],
)
def test_positions_at_their_stamp_are_the_true_ones_over_many_turns(
    link: Path, start: Start, counts: Counts, turning: Turning, echo: bool, turns: str, strobe: bool
) -> None:
    with SeiBusEmulator(link, counts, turning, echo=echo, multi_turn=turns == "multi", strobe=strobe):
        bus = start(turns=turns, strobe=strobe)
        bus.wait_for(lambda: sum(len(reading.names) == 2 for reading in bus.readings) >= 22)
    for reading, looked_ns in zip(bus.readings, turning.looked_ns(bus.readings, ADDRESSES), strict=True):
        mean_ns = sum(looked_ns.values()) / len(looked_ns)
        assert reading.measured_ns - protocol.SNAPSHOT_NS / 2 <= mean_ns  # a look is as old as that at the most
        assert max(looked_ns.values()) <= reading.complete_ns
    first, *_, last = (reading for reading in bus.readings if len(reading.names) == 2)
    for index, sign in enumerate((1, -1)):  # the right wheel counts backward
        turned_rad = math.tau * (last.counts[index] - first.counts[index]) / COUNTS
        assert last.positions_rad[index] - first.positions_rad[index] == pytest.approx(sign * turned_rad, abs=math.pi)
    bus.assert_one_a_tick()
    assert bus.device.diagnostics["echo"] == ("yes" if echo else "no")
    assert bus.device.identity["right_wheel"].endswith(f"address 5, serial number 61005, {turns}-turn, ok")


def test_steering_is_signed_about_its_zero(link: Path, start: Start) -> None:
    steering = Encoder(name="steering", role="steering", address=1, zero_deg=355.0)
    with SeiBusEmulator(link, {1: COUNTS}, lambda _address, _at_ns: round(10 / 360 * COUNTS)):
        bus = start(encoders=(steering,))
        bus.wait_for_readings(1)
    assert bus.readings[0].positions_rad == (pytest.approx(math.radians(15.0), abs=2e-3),)


def test_a_position_that_begins_like_its_request_is_no_echo(link: Path, start: Start) -> None:
    wide = Encoder(name="steering", role="steering", address=0, counts_per_turn=65536)
    with SeiBusEmulator(link, {0: 65536}, lambda _address, _at_ns: 0x10AB):
        bus = start(encoders=(wide,))
        bus.wait_for_readings(2)
        assert bus.device.diagnostics["echo"] == "no"
        assert {reading.counts for reading in bus.readings} == {(0x10AB,)}


def test_a_profile_with_the_wrong_turns_or_echo_is_told(
    link: Path, start: Start, counts: Counts, turning: Turning
) -> None:
    with SeiBusEmulator(link, counts, turning, multi_turn=True):
        wrong_turns = start()
        wrong_turns.wait_for_message("encoder_bus.turns = 'single'")
        wrong_turns.device.close()
        wrong_echo = start(turns="multi", echo="yes")
        wrong_echo.wait_for_message("encoder_bus.echo is 'yes'")


def test_the_lead_follows_slow_rounds_up_to_a_bound_and_forgets_them() -> None:
    timing = RoundTiming(7_000_000)
    for _ in range(2000):
        timing.add(0, 7_000_000)
    assert timing.lead_ns == pytest.approx(7_000_000 + SAFETY_NS, abs=2000)
    timing.add(0, 9_000_000)
    assert timing.lead_ns >= 9_000_000 + SAFETY_NS
    timing.add(0, 500_000_000)  # the whole process stood still
    assert timing.lead_ns <= 9_000_000 + 1.2 * MAX_LATE_NS + SAFETY_NS
    for _ in range(2000):
        timing.add(0, 7_000_000)
    assert timing.lead_ns == pytest.approx(7_000_000 + SAFETY_NS, abs=2000)
