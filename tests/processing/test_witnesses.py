"""Wheels and walls step by step along a drift: what either says wrongly, and what the chain makes of it.

The vehicle drives straight on, 0.2 m a scan; where the walls are smooth they show no way, where rough all of it.
"""

from dataclasses import replace

import numpy as np
import pytest
from made_scans import MOUNT, look, walls

from processing.chain import HONEST, Chain, _honest_share
from processing.chain_step import to_laser
from processing.scan_match import ScanMatch
from processing.scan_matching import Matcher, match_scans
from processing.scan_walls import Scan

STEP, NOISE = np.array([0.2, 0.0, 0.0]), np.diag([1e-5, 1e-6, 1e-6])
SIDES = [(-40, -2.2), (40, -2.2)], [(-40, 2.2), (40, 2.2)]
SMOOTH, ROUGH = walls(*SIDES), walls(*SIDES, roughness_m=0.15)
STEPS = 3  # before the one that is looked at: no new key frame is due


def seen(world: object, k: int) -> Scan:
    return look(world, k * STEP, k)


def drive(world: object, match: Matcher = match_scans, is_even: bool = False) -> Chain:
    """A chain after some steps of which everyone says the same."""
    chain = Chain(10, MOUNT, match, is_even)
    chain.add_keyframe(0, seen(world, 0))
    for k in range(1, STEPS):
        assert chain.advance(k, seen(world, k), STEP, NOISE, 0.1)
    assert chain.contradictions == []
    return chain


def assert_offset(chain: Chain, metres: float, within_m: float = 0.03) -> None:
    assert abs(chain.offset[0] - metres) < within_m
    assert abs(chain.offset[1]) < 0.02
    assert abs(chain.offset[2]) < 0.01


def lying(by: np.ndarray) -> Matcher:
    """A matcher that is off by so much of the vehicle (3,) at scan STEPS, and sure of itself."""

    def match(reference: Scan, current: Scan, guess: np.ndarray) -> ScanMatch:
        found = match_scans(reference, current, guess)
        if np.hypot(*guess[:2]) < (STEPS - 0.5) * STEP[0]:
            return found
        true = to_laser(MOUNT, MOUNT, STEPS * STEP + by)
        return replace(found, motion=true, covariance=np.diag([1e-6, 1e-6, 1e-7]))

    return match


@pytest.mark.parametrize(
    "said",
    [[-0.3, 0.0, 0.0], [0.9, 0.0, 0.0], [0.2, 0.0, 0.15], [1.6, 0.0, 0.8]],
    ids=["back", "far", "turned", "both"],
)
def test_rough_walls_convict_the_wheels_and_say_the_way(said: list[float]) -> None:
    """Also where the scans cannot be matched from where the wheels put the vehicle: its motion so far says where."""
    chain = drive(ROUGH)
    assert chain.advance(STEPS, seen(ROUGH, STEPS), np.array(said), NOISE, 0.1)
    assert [(of.scan, of.convicts_wheels) for of in chain.contradictions] == [(STEPS, True)]
    assert_offset(chain, STEPS * STEP[0])


def test_wheels_count_on_from_where_the_walls_put_the_vehicle() -> None:
    chain = drive(ROUGH)
    assert chain.advance(STEPS, seen(ROUGH, STEPS), np.array([0.9, 0.0, 0.3]), NOISE, 0.1)
    for k in range(STEPS + 1, STEPS + 4):
        assert chain.advance(k, seen(ROUGH, k), STEP, NOISE, 0.1)
    assert len(chain.contradictions) == 1
    assert_offset(chain, (STEPS + 3) * STEP[0])
    np.testing.assert_allclose(chain.driven, chain.offset, atol=0.05)


def test_smooth_walls_leave_the_way_to_the_wheels_and_take_the_turn() -> None:
    chain = drive(SMOOTH)
    assert chain.advance(STEPS, seen(SMOOTH, STEPS), np.array([0.3, 0.0, 0.15]), NOISE, 0.1)
    assert_offset(chain, (STEPS - 1) * STEP[0] + 0.3, 0.12)


@pytest.mark.parametrize("by_m", [-0.2, 0.3])
def test_a_match_that_fits_anywhere_along_convicts_the_scan(by_m: float) -> None:
    """As of a vehicle ahead that drives along: between smooth walls the wheels are right about the way."""
    chain = drive(SMOOTH, lying(np.array([by_m, 0.0, 0.0])))
    assert chain.advance(STEPS, seen(SMOOTH, STEPS), STEP, NOISE, 0.1)
    assert [(of.scan, of.convicts_wheels) for of in chain.contradictions] == [(STEPS, False)]
    assert_offset(chain, STEPS * STEP[0])


@pytest.mark.parametrize("world", [SMOOTH, ROUGH], ids=["smooth", "rough"])
def test_a_match_that_is_turned_where_the_walls_are_not_is_none(world: object) -> None:
    chain = drive(world, lying(np.array([0.0, 0.0, 0.1])))
    assert not chain.advance(STEPS, seen(world, STEPS), STEP, NOISE, 0.1)
    assert chain.contradictions == []
    assert_offset(chain, (STEPS - 1) * STEP[0])


def test_a_match_that_no_vehicle_can_have_made_convicts_no_wheels(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("processing.chain.objection", lambda *_: 1.0)  # however much the walls object
    chain = drive(ROUGH, lying(np.array([0.7, 0.0, 0.0])))
    chain.advance(STEPS, seen(ROUGH, STEPS), STEP, NOISE, 0.1)
    assert not any(of.convicts_wheels for of in chain.contradictions)
    assert_offset(chain, STEPS * STEP[0])


@pytest.mark.parametrize("is_even", [True, False])
def test_wheels_that_stop_at_once_have_no_benefit_of_the_doubt(is_even: bool) -> None:
    """Walls that are hardly rough hardly object; but no vehicle stops at once, if its stamps can be trusted."""
    world = walls(*SIDES, roughness_m=0.022)
    chain = drive(world, is_even=is_even)
    assert chain.advance(STEPS, seen(world, STEPS), np.zeros(3), NOISE, 0.1)
    assert [of.convicts_wheels for of in chain.contradictions] == [is_even]
    assert_offset(chain, (STEPS - 1 + is_even) * STEP[0])


def test_suspicion_of_the_wheels_ends_when_they_agree_with_the_walls_again() -> None:
    """Three seconds of it are too long for a slip; but those of long ago do not count."""
    world = walls(*SIDES, roughness_m=0.022)
    chain = drive(world, is_even=True)
    chain.suspect_s = 2.95
    assert chain.advance(STEPS, seen(world, STEPS), STEP, NOISE, 0.1)
    assert chain.advance(STEPS + 1, seen(world, STEPS + 1), 0.1 * STEP, NOISE, 0.1)
    assert [of.convicts_wheels for of in chain.contradictions] == [True]


def test_wheels_that_were_a_little_off_are_doubted_along_the_way_too() -> None:
    """One wheel that slips turns the vehicle and counts half of it as way; nothing of it is worth telling."""
    turned, chain = np.array([0.0, 0.0, 0.012]), drive(SMOOTH, is_even=True)
    before_m2 = chain.driven_covariance[0, 0]
    assert chain.advance(STEPS, seen(SMOOTH, STEPS), STEP + turned, NOISE, 0.1)
    assert chain.contradictions == []
    assert chain.driven_covariance[0, 0] - before_m2 > 5 * NOISE[0, 0]
    assert_offset(chain, STEPS * STEP[0])


def test_after_a_pause_a_single_match_convicts_nobody() -> None:
    """The vehicle may have kept its motion for 1.5 s, as the walls say; or have done what the wheels say."""
    chain, later = drive(ROUGH), STEPS - 1 + 15
    assert not chain.advance(STEPS, seen(ROUGH, later), np.array([2.4, 0.0, 0.2]), NOISE, 1.5)
    assert chain.contradictions == []
    assert chain.advance(STEPS, seen(ROUGH, later), 15 * STEP, NOISE, 1.5)  # unless they say the same


def test_what_had_to_be_searched_for_convicts_nobody() -> None:
    for step, found in ((STEP + np.array([0.1, 0.05, 0.02]), True), (np.array([0.6, 0.0, 0.3]), False)):
        chain = drive(ROUGH)
        ample = 100 * NOISE if found else NOISE
        assert chain.find(STEPS, seen(ROUGH, STEPS), step, ample, 0.1) == found
        assert chain.contradictions == []
        assert_offset(chain, (STEPS - 1 + found) * STEP[0])


def test_a_scan_that_saw_nothing_leaves_all_as_it_was() -> None:
    chain = drive(ROUGH)
    nothing = look(walls([(500, 0), (510, 0)]), STEPS * STEP, 1)
    assert not chain.advance(STEPS, nothing, STEP, NOISE, 0.1)
    assert_offset(chain, (STEPS - 1) * STEP[0])
    chain.coast(STEPS, STEP, NOISE, 0.1)
    assert_offset(chain, STEPS * STEP[0])
    assert not chain.matched[STEPS]
    assert chain.wants_keyframe


def test_wheels_are_honest_axis_by_axis() -> None:
    deviations = np.array([0.01, 0.002, 0.001])
    covariance = np.diag(deviations**2)
    for missed in 0.9 * HONEST * deviations * np.array([[1, -1, 1], [-1, 1, 1], [0, 0, -1]]):
        np.testing.assert_allclose(_honest_share(missed, covariance), missed)
    for axis in range(3):
        missed = 0.5 * deviations
        missed[axis] *= 10 * HONEST
        expected = missed.copy()
        expected[axis] = 0.0
        np.testing.assert_allclose(_honest_share(missed, covariance), expected, atol=1e-12)
