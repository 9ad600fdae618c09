"""Counting on over many turns, and the angles that JointState tells."""

import math
import threading
import time
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from patience import PATIENCE_S

from hw_profiles.profile import Encoder
from rtlog_server.devices.device import TickGrid
from rtlog_server.devices.encoders import (
    EncoderDevice,
    Fix,
    ReadingMaker,
    TurnCounter,
    counts_at,
    nearest_total,
    position_rad,
)
from rtlog_server.messages import OK, STALE

COUNTS = 4096
RADIUS_M = 0.35
TURN_M = 2 * math.pi * RADIUS_M
TICK_NS = 100_000_000
STEERING = Encoder(name="steering", role="steering", counts_per_turn=COUNTS, zero_deg=350.0)
WHEEL = Encoder(name="wheel", role="left_wheel", counts_per_turn=COUNTS, wheel_radius_m=RADIUS_M)


def counts_of(distance_m: float) -> int:
    return math.floor(distance_m / TURN_M * COUNTS)


@given(st.integers(-(10**9), 10**9), st.integers(0, COUNTS - 1))
def test_the_nearest_total_fits_the_reading_and_lies_within_half_a_turn(near: int, raw: int) -> None:
    total = nearest_total(raw, COUNTS, near)
    assert total % COUNTS == raw
    assert -COUNTS // 2 <= total - near <= COUNTS // 2


@settings(deadline=None, max_examples=50)
@given(st.lists(st.floats(-0.4, 0.4), min_size=20, max_size=60), st.floats(-0.3, 0.3))
def test_a_wheel_counts_on_through_any_drive(accelerations_m_s_tick: list[float], first_m: float) -> None:
    counter = TurnCounter(COUNTS, COUNTS, RADIUS_M)
    distance_m, speed_m_s = first_m, 0.0
    offset = counts_of(distance_m) - counts_of(distance_m) % COUNTS
    for index, change_m_s in enumerate(accelerations_m_s_tick):
        total, doubtful = counter.count(counts_of(distance_m) % COUNTS, index * TICK_NS)
        assert total == counts_of(distance_m) - offset
        assert not doubtful
        speed_m_s = max(-8.0, min(8.0, speed_m_s + change_m_s))
        distance_m += speed_m_s * 0.1


def test_a_gap_that_the_speed_bridges_is_counted_and_a_longer_one_is_doubtful() -> None:
    speed_m_s = 5.0
    counter = TurnCounter(COUNTS, COUNTS, RADIUS_M)
    for index in range(3):
        counter.count(counts_of(speed_m_s * 0.1 * index) % COUNTS, index * TICK_NS)
    # 0.5 s on: more than a turn further, which only the speed tells
    at_s = 0.7
    assert counter.count(counts_of(speed_m_s * at_s) % COUNTS, int(at_s * 1e9)) == (counts_of(speed_m_s * at_s), False)
    at_s += 3.0
    total, doubtful = counter.count(counts_of(speed_m_s * at_s) % COUNTS, int(at_s * 1e9))
    assert doubtful
    assert total % COUNTS == counts_of(speed_m_s * at_s) % COUNTS
    assert abs(total - counts_of(speed_m_s * 0.7)) <= COUNTS // 2  # the least movement


def test_a_jump_that_no_wheel_can_make_is_doubtful() -> None:
    counter = TurnCounter(COUNTS, COUNTS, RADIUS_M)
    assert counter.count(100, 0) == (100, False)
    assert counter.count(110, TICK_NS) == (110, False)
    assert counter.count(110 + COUNTS // 3, 2 * TICK_NS)[1]


def test_an_encoder_that_counts_turns_bridges_any_gap_until_it_loses_power() -> None:
    modulus = COUNTS * 65536
    counter = TurnCounter(COUNTS, modulus, RADIUS_M)
    assert counter.count(modulus - 5, 0) == (modulus - 5, False)
    assert counter.count(3, TICK_NS) == (modulus + 3, False)  # over the end of the turn count
    assert counter.count(20 * COUNTS, 60 * 10**9) == (modulus + 20 * COUNTS, False)
    # power lost: the turns start at 0 again, the place within the turn stays
    total, doubtful = counter.count(40, 60 * 10**9 + TICK_NS)
    assert doubtful
    assert total == modulus + 20 * COUNTS + 40
    assert counter.count(50, 60 * 10**9 + 2 * TICK_NS) == (modulus + 20 * COUNTS + 50, False)  # told once


def test_positions_of_encoders_asked_in_turn_are_brought_to_one_stamp() -> None:
    wheel = Encoder(name="wheel", role="left_wheel", counts_per_turn=COUNTS, wheel_radius_m=RADIUS_M)
    maker = ReadingMaker([wheel, STEERING], {"wheel": COUNTS, "steering": COUNTS})
    zero = round(350 / 360 * COUNTS)
    for tick in range(4):
        start_ns = tick * TICK_NS
        # 400 counts a tick forward and 100 to the left, latched 10 ms apart: the stamp lies between
        wheel_fix = Fix(400 * tick, start_ns, start_ns + 1)
        steering_fix = Fix((zero + 100 * tick + 10) % COUNTS, start_ns + TICK_NS // 10, start_ns + TICK_NS // 10 + 1)
        reading = maker.reading({"wheel": wheel_fix, "steering": steering_fix})
    assert reading.measured_ns == 3 * TICK_NS + TICK_NS // 20
    assert reading.counts[0] == 1200
    per_count = 2 * math.pi / COUNTS
    assert reading.positions_rad == (pytest.approx(1220 * per_count), pytest.approx(305 * per_count, abs=per_count))


def test_a_position_where_no_wheel_can_be_is_told_before_it_is_counted() -> None:
    wheel = Encoder(name="wheel", role="left_wheel", counts_per_turn=COUNTS, wheel_radius_m=RADIUS_M)
    maker = ReadingMaker([wheel], {"wheel": COUNTS})
    for tick in range(3):
        fix = Fix(10 * tick, tick * TICK_NS, tick * TICK_NS)
        assert maker.is_possible("wheel", fix)
        maker.reading({"wheel": fix})
    assert not maker.is_possible("wheel", Fix(COUNTS // 3, 3 * TICK_NS, 3 * TICK_NS))
    assert maker.is_possible("wheel", Fix(COUNTS // 3, 60 * 10**9, 60 * 10**9))  # after a minute it can be anywhere
    assert maker.is_possible("wheel", Fix(40, 3 * TICK_NS, 3 * TICK_NS))


@given(st.floats(-math.pi + 0.01, math.pi - 0.01), st.booleans(), st.floats(-360, 360))
def test_steering_is_signed_about_its_zero(angle_rad: float, is_reversed: bool, zero_deg: float) -> None:
    encoder = Encoder(name="s", role="steering", counts_per_turn=COUNTS, zero_deg=zero_deg, reversed=is_reversed)
    counts = counts_at(encoder, angle_rad)
    assert 0 <= counts < COUNTS
    assert position_rad(encoder, counts) == pytest.approx(angle_rad, abs=math.pi / COUNTS + 1e-9)


def test_angles_have_the_sign_that_the_profile_says() -> None:
    zero = round(350 / 360 * COUNTS)
    assert position_rad(STEERING, (zero + 114) % COUNTS) == pytest.approx(math.radians(10.0), abs=2e-3)
    assert position_rad(WHEEL, 3 * COUNTS) == pytest.approx(6 * math.pi)
    backward = Encoder(name="w", role="left_wheel", wheel_radius_m=RADIUS_M, reversed=True)
    assert position_rad(backward, 3 * COUNTS) == pytest.approx(-6 * math.pi)
    assert counts_at(backward, -math.pi) == COUNTS // 2
    assert counts_at(backward, 6 * math.pi) == -3 * COUNTS


@pytest.mark.parametrize("late_ns", [1_000_000, 60_000_000, 100_000_000])
@pytest.mark.parametrize("wrong_rad", [-2.5, -1.7, 1.7, 2.5])
def test_a_wrong_answer_does_not_set_a_wheel_turning_for_ever(wrong_rad: float, late_ns: int) -> None:
    counter = TurnCounter(COUNTS, COUNTS, RADIUS_M)
    per_tick = 260  # 4 rad/s
    for tick in range(10):
        counter.count(tick * per_tick % COUNTS, tick * TICK_NS)
    wrong = round(9 * per_tick + wrong_rad / math.tau * COUNTS) % COUNTS
    counter.count(wrong, 9 * TICK_NS + late_ns)  # another encoder's, or noise
    totals = [counter.count(tick * per_tick % COUNTS, tick * TICK_NS)[0] for tick in range(11, 30)]
    assert {b - a for a, b in pairwise(totals)} == {per_tick}
    assert abs(totals[-1] - 29 * per_tick) <= COUNTS


class Wordless(EncoderDevice):
    """Connected, and never a reading."""

    def __init__(self) -> None:
        super().__init__("encoders")
        self.serving = threading.Event()

    def connect(self) -> None:
        pass

    def read(self) -> None:
        self.serving.set()
        self.pause(0.01)

    def disconnect(self) -> None:
        pass


@pytest.mark.parametrize(("period_ms", "patience_ms"), [(10, 350), (100, 350), (1000, 3000)])
def test_encoders_are_stale_after_three_ticks_but_not_too_soon(period_ms: int, patience_ms: int) -> None:
    device = Wordless()
    before_ns = time.monotonic_ns()
    device.start(TickGrid(before_ns, period_ms * 1_000_000))
    assert device.serving.wait(PATIENCE_S)
    after_ns = time.monotonic_ns()
    assert device.collect(before_ns + (patience_ms - 1) * 1_000_000).state == OK
    assert device.collect(after_ns + (patience_ms + 1) * 1_000_000).state == STALE
    device.close()
