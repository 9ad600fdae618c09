"""Matches that are known are made again only where the poses no longer say what they found."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from processing.geometry import compose, relative
from processing.known_matches import CONFIRMED, Matches, find_rows, match_loops
from processing.scan_match import ScanMatch
from processing.scan_matching import match_scans
from processing.scan_walls import Scan, prepare_scan
from processing.strong_links import KeyFrames

ANGLES = np.radians(np.arange(-135, 135.1, 0.5))
POSES = np.array([[0.0, 0, 0], [0.4, 0.1, 0.05], [0.8, 0.0, np.pi / 2], [1.2, 0.1, 0.0]])
PAIRS = np.array([[1, 0], [2, 0], [1, 3]])


def look(pose: np.ndarray) -> Scan:
    """A room of 8 × 6 m."""
    heading = ANGLES + pose[2]
    with np.errstate(divide="ignore"):
        across = np.where(np.cos(heading) > 0, 4 - pose[0], 4 + pose[0]) / np.abs(np.cos(heading))
        along = np.where(np.sin(heading) > 0, 3 - pose[1], 3 + pose[1]) / np.abs(np.sin(heading))
    ranges = np.minimum(across, along)
    return prepare_scan(np.column_stack([ranges * np.cos(ANGLES), ranges * np.sin(ANGLES)]), ANGLES[0], np.radians(0.5))


@pytest.fixture
def frames() -> tuple[KeyFrames, list[np.ndarray]]:
    """Four in the room, and the guesses of the matches that were made."""
    guesses: list[np.ndarray] = []

    def match(reference: Scan, current: Scan, guess: np.ndarray) -> ScanMatch:
        guesses.append(guess)
        return match_scans(reference, current, guess)

    scans = [look(pose) for pose in POSES]
    return KeyFrames(scans, np.arange(4), np.zeros(4), np.zeros((4, 3)), match), guesses


def test_what_the_poses_confirm_is_not_matched_again(frames: tuple[KeyFrames, list[np.ndarray]]) -> None:
    of, guesses = frames
    astray = POSES + np.array([[0, 0, 0], [0.2, -0.1, 0.03], [0.1, 0.1, 0], [0, 0.2, 0]])
    first = match_loops(of, astray, PAIRS, Matches.none())
    assert first.pairs.tolist() == [[0, 1], [0, 2], [1, 3]]
    assert first.links.ends.tolist() == first.pairs.tolist()
    assert_allclose(first.motions, relative(POSES[first.pairs[:, 0]], POSES[first.pairs[:, 1]]), atol=2e-3)
    turned = POSES + np.array([0, 0, 2 * np.pi])  # the same poses
    second = match_loops(of, turned, PAIRS, first)
    assert len(guesses) == 3
    assert_allclose(second.motions, first.motions, atol=1e-12)
    moved = POSES + np.array([[0, 0, 0], [0, 0, 0], [2 * CONFIRMED[0], 0, 0], [0, 0, 0]])
    third = match_loops(of, moved, PAIRS[1:], first)
    assert len(guesses) == 4  # of 0 and 2 alone
    assert sorted(third.links.ends.tolist()) == [[0, 2], [1, 3]]


def test_a_pair_that_did_not_match_is_tried_again_from_elsewhere_alone(
    frames: tuple[KeyFrames, list[np.ndarray]],
) -> None:
    of, guesses = frames
    blind = replace(of.scans[0], points=np.full((541, 2), np.nan), normals=np.full((541, 2), np.nan))
    of = replace(of, scans=[blind, *of.scans[1:]])
    known = match_loops(of, POSES, PAIRS, Matches.none())
    assert known.links.ends.tolist() == [[1, 3]]
    match_loops(of, POSES, PAIRS, known)
    assert len(guesses) == 3
    match_loops(of, compose(np.array([3.0, 1.0, 0.5]), POSES), PAIRS, known)  # moved as one: nothing changed
    assert len(guesses) == 3
    match_loops(of, POSES * [1.2, 1, 1], PAIRS, known)
    assert len(guesses) == 6


def test_matches_of_other_pairs_are_joined(frames: tuple[KeyFrames, list[np.ndarray]]) -> None:
    of, guesses = frames
    parts = [match_loops(of, POSES, PAIRS[k : k + 1], Matches.none()) for k in (2, 0, 1)]
    whole = Matches.joined(parts)
    again = match_loops(of, POSES, PAIRS, whole)
    assert len(guesses) == 3
    assert_allclose(again.motions, whole.motions)
    assert_allclose(whole.motions, match_loops(of, POSES, PAIRS, Matches.none()).motions)


def test_rows_are_found_among_sorted_ones() -> None:
    rng = np.random.default_rng(4)
    among = np.unique(rng.integers(0, 30, (80, 2)), axis=0)
    rows = rng.integers(0, 30, (200, 2))
    expected = [next((k for k, row in enumerate(among.tolist()) if row == wanted), -1) for wanted in rows.tolist()]
    assert find_rows(rows, among).tolist() == expected
    assert find_rows(rows[:2], np.zeros((0, 2), np.int64)).tolist() == [-1, -1]
