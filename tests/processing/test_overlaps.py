"""Overlaps of pieces are matched once, and again only where the assembly says something else."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from processing.boundary import find_boundary
from processing.edge_placement import Placement, place_by_frames
from processing.geometry import compose
from processing.graph import Graph
from processing.overlaps import Known, confirms, find_overlaps, link_overlaps
from processing.pieces import SolvedPiece
from processing.scan_match import ScanMatch
from processing.scan_matching import match_scans
from processing.scan_walls import Scan
from processing.workers import Workers

Solved = tuple[Graph, list[SolvedPiece]]


@pytest.fixture(scope="module")
def placed(solved: Solved) -> tuple[Placement, Known]:
    known: Known = {}
    return place_by_frames(solved[1], solved[0], match_scans, Workers(1), known), known


def test_what_the_assembly_confirms_is_not_matched_again(placed: tuple[Placement, Known]) -> None:
    placement, known = placed
    pieces = [of.solved for of in placement.pieces]
    frames, parts = [of.frame for of in placement.pieces], [0] * len(placement.pieces)
    pieces = [
        replace(piece, map=replace(piece.map, poses=of.edge_poses))
        for piece, of in zip(pieces, placement.pieces, strict=True)
    ]
    matched = 0

    def count(reference: Scan, current: Scan, guess: np.ndarray) -> ScanMatch:
        nonlocal matched
        matched += 1
        return match_scans(reference, current, guess)

    anew = link_overlaps(find_overlaps(pieces, frames, parts, {}), find_boundary(pieces), count, Workers(1), {})
    all_matched, matched = matched, 0
    again = link_overlaps(find_overlaps(pieces, frames, parts, known), find_boundary(pieces), count, Workers(1), known)
    assert all_matched > 20
    assert matched < 0.2 * all_matched
    assert again.ends.tolist() == anew.ends.tolist()
    assert_allclose(again.motions, anew.motions, atol=0.05)
    matched = 0
    moved = [compose(frame, np.array([0.4 * (k % 2), 0.0, 0.0])) for k, frame in enumerate(frames)]
    link_overlaps(find_overlaps(pieces, moved, parts, known), find_boundary(pieces), count, Workers(1), known)
    assert matched > 0.3 * all_matched


@pytest.mark.parametrize(
    ("guess", "expected"),
    [
        ((0.0, 0.0, 0.0), True),
        ((0.1, 0.02, 0.005), True),  # what was found
        ((0.3, 0.02, 0.005), True),  # along the drift
        ((0.5, 0.02, 0.005), False),
        ((0.1, 0.1, 0.005), False),  # across
        ((0.1, 0.02, 0.03), False),
        ((0.1, 0.02, 0.005 - 2 * np.pi), True),
    ],
)
def test_walls_that_leave_a_direction_open_confirm_along_it(guess: tuple[float, ...], expected: bool) -> None:
    found = ScanMatch(np.array([0.1, 0.02, 0.005]), np.diag([1e4, 1e-4, 1e-6]), 0.9, 0.01, True)
    assert confirms(np.array(guess), np.array([0.1, 0.0, 0.0]), found) == expected


def test_a_match_that_failed_fails_from_the_same_guess_alone() -> None:
    failed = ScanMatch(np.zeros(3), np.eye(3) * 1e4, 0.1, np.inf, False)
    assert confirms(np.array([0.02, 0.0, 0.0]), np.zeros(3), failed)
    assert not confirms(np.array([0.05, 0.0, 0.0]), np.zeros(3), failed)
