"""The encoders' driver against emulated encoders that do as they should."""

import itertools
import math
import statistics
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from hw_profiles.profile import Encoder
from rtlog_server.devices.sei.emulator import SeiBusEmulator
from rtlog_server.devices.sei.round_timing import MAX_LATE_NS, SAFETY_NS, RoundTiming

COUNTS = 4096
TURNS_PER_S = {0: 2.3, 5: -1.7}  # as `turning` does
SIGNS = {0: 1, 5: -1}  # the right wheel counts backward
LATCH_S = 0.005  # the look at the disc each 4 ms, and a busy machine

Start = Callable[..., Any]
Turning = Callable[[int, int], int]
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
        bus.wait_for_readings(22)
    errors_s: dict[int, list[float]] = {0: [], 5: []}
    # the first has no speed yet; a machine with other work may let an answer wait for too long
    first, *readings = [r for r in bus.readings if r.names == ("left_wheel", "right_wheel") and not r.doubtful]
    assert len(readings) > 15
    for reading in readings:
        elapsed_ns = reading.measured_ns - first.measured_ns
        for index, address in enumerate(counts):
            moved_rad = reading.positions_rad[index] - first.positions_rad[index]
            true_rad = SIGNS[address] * 2 * math.pi * TURNS_PER_S[address] * elapsed_ns * 1e-9
            assert abs(moved_rad - true_rad) < math.pi / 2  # no turn too many or too few
            true_counts = turning(address, reading.measured_ns)
            error = (
                SIGNS[address] * reading.positions_rad[index] / (2 * math.pi) - true_counts / COUNTS + 0.5
            ) % 1 - 0.5
            errors_s[address].append(error / TURNS_PER_S[address])
    for address in counts:
        assert sorted(map(abs, errors_s[address]))[12] < LATCH_S  # the rest: a machine with other work
        assert abs(statistics.median(errors_s[address])) < 0.002  # each at the common stamp, not only their mean
    assert abs(bus.readings[-1].counts[0] - first.counts[0]) > 1.4 * COUNTS
    assert bus.device.diagnostics["echo"] == ("yes" if echo else "no")
    assert bus.device.identity["right_wheel"].endswith(f"address 5, serial number 61005, {turns}-turn, ok")


def test_each_tick_has_a_reading_taken_just_before_it(
    link: Path, start: Start, counts: Counts, turning: Turning
) -> None:
    with SeiBusEmulator(link, counts, turning):
        bus = start()
        bus.wait_for_readings(30)
    settled = sorted(bus.ages_s[5:])
    assert settled[len(settled) // 2] < 0.025  # `bench_sei.py` measures it
    stamps = [reading.measured_ns for reading in bus.readings]
    assert all(after - before > 0.4 * 33_300_000 for before, after in itertools.pairwise(stamps))


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
        wrong_turns.wait_for(lambda: "encoder_bus.turns = 'single'" in wrong_turns.device.message)
        wrong_turns.device.close()
        wrong_echo = start(turns="multi", echo="yes")
        wrong_echo.wait_for(lambda: "encoder_bus.echo is 'yes'" in wrong_echo.device.message)


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
