"""Stretches around a tag: what two drives saw of one drift agrees, and of the wrong way round only where it tells."""

import numpy as np
import pytest
from made_scans import look, walls
from numpy.testing import assert_allclose

from processing.geometry import compose, inverse, relative
from processing.stretches import REACH_M, SPACING_M, Stretch, contradiction, stretch_of, stretch_rows

WAY = np.arange(-44, 46, 2.0)  # the tag hangs at 0
AHEAD = np.column_stack([WAY, np.zeros(45), np.zeros(45)])
AROUND = np.column_stack([np.minimum(WAY, 30), np.maximum(WAY - 30, 0), np.where(WAY > 30, np.pi / 2, 0.0)])
TURNED = np.array([0.0, 0.0, np.pi])


STRAIGHT = walls([(-90, -2.2), (90, -2.2)], [(-90, 2.2), (90, 2.2)])
BENT = walls([(-90, -2.2), (32.2, -2.2), (32.2, 60)], [(-90, 2.2), (27.8, 2.2), (27.8, 60)])


@pytest.fixture(scope="module", params=[False, True], ids=["straight", "bent"])
def both(request: pytest.FixtureRequest) -> tuple[bool, Stretch, Stretch, np.ndarray]:
    """Is there a bend? Drives there and back past the tag, and how the second lies to the first."""
    world, there = (BENT, AROUND) if request.param else (STRAIGHT, AHEAD)
    back = compose(there[::-1], TURNED)
    passes = there[22], back[22] + np.array([0.8, 0.0, 0.0])  # read a little too early
    one, other = (
        stretch_of(poses, [look(world, pose, k) for k, pose in enumerate(poses)], at)
        for poses, at in zip((there, back), passes, strict=True)
    )
    return request.param, one, other, relative(*passes)


def test_drives_both_ways_saw_the_same_drift(both: tuple[bool, Stretch, Stretch, np.ndarray]) -> None:
    _, one, other, motion = both
    assert contradiction(one, other, motion) < 0.5
    assert contradiction(one, other, motion + np.array([0.2, 0.2, 0.005])) < 0.5  # drawn to a cell, no better


def test_only_a_bend_tells_the_wrong_way_round(both: tuple[bool, Stretch, Stretch, np.ndarray]) -> None:
    is_bent, one, other, motion = both
    assert (contradiction(one, other, compose(motion, TURNED)) > 3) == is_bent


def test_only_a_bend_tells_how_far_along(both: tuple[bool, Stretch, Stretch, np.ndarray]) -> None:
    is_bent, one, other, motion = both
    for metres in (-3.0, 3.0):
        assert (contradiction(one, other, motion + np.array([metres, 0.0, 0.0])) > 1) == is_bent


def test_a_drift_across_contradicts(both: tuple[bool, Stretch, Stretch, np.ndarray]) -> None:
    _, one, other, motion = both
    assert contradiction(one, other, compose(motion, np.array([0.0, 0.0, np.pi / 2]))) > 3


def test_it_is_the_same_seen_from_either_drive(both: tuple[bool, Stretch, Stretch, np.ndarray]) -> None:
    _, one, other, motion = both
    for move in (motion, compose(motion, TURNED)):
        assert contradiction(one, other, move) == pytest.approx(contradiction(other, one, inverse(move)))


def test_what_only_one_of_them_saw_says_nothing(both: tuple[bool, Stretch, Stretch, np.ndarray]) -> None:
    _, one, other, motion = both
    assert contradiction(one, other, motion + np.array([0.0, 300.0, 0.0])) == 0


def test_a_stretch_lies_in_the_frame_of_its_pass() -> None:
    moved = np.array([300.0, -20.0, 2.0])
    scans = [look(BENT, pose, k) for k, pose in enumerate(AROUND)]
    here, there = (stretch_of(poses, scans, poses[22]) for poses in (AROUND, compose(moved, AROUND)))
    assert_allclose(here.points, there.points, atol=1e-6)
    assert contradiction(here, there, np.zeros(3)) == pytest.approx(contradiction(here, here, np.zeros(3)))


def test_scans_are_looked_at_some_metres_apart_and_no_further_than_open_loop_is_right() -> None:
    poses = np.column_stack([np.arange(0, 300, 0.7), np.zeros(429), np.zeros(429)])
    rows = stretch_rows(poses, 200)
    assert np.all(np.abs(poses[rows, 0] - poses[200, 0]) < REACH_M)
    assert np.ptp(poses[rows, 0]) > 2 * REACH_M - 2 * SPACING_M
    assert np.median(np.diff(poses[rows, 0])) == pytest.approx(SPACING_M, abs=0.15)
    parked = np.repeat(poses[:1], 1000, axis=0)
    assert len(stretch_rows(parked, 500)) == 1
