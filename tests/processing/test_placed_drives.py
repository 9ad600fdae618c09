"""Whole drives out of the pieces that they were cut into, and where on them the tags were passed."""

from collections.abc import Callable

import numpy as np
import pytest

from processing.boundary import find_boundary
from processing.geometry import align, compose
from processing.graph import Graph
from processing.part_joining import PlacedDrive
from processing.pieces import SolvedPiece
from processing.pipeline import DrivenRun
from processing.placed_drives import find_tag_passes, place_drives

Solved = tuple[Graph, list[SolvedPiece]]


@pytest.fixture(scope="module")
def frames(
    solved: Solved, driven: list[DrivenRun], true_keyframes: Callable[[SolvedPiece, list[DrivenRun]], np.ndarray]
) -> list[np.ndarray]:
    """The frames of the pieces where the truth has them."""
    return [align(of.map.poses[:, :2], true_keyframes(of, driven)[:, :2]) for of in solved[1]]


@pytest.fixture(scope="module")
def drives(solved: Solved, frames: list[np.ndarray]) -> list[PlacedDrive]:
    return place_drives(solved[1], frames, [5] * len(frames))


def test_every_key_frame_lies_where_the_vehicle_was(
    drives: list[PlacedDrive], driven: list[DrivenRun], truth: list[np.ndarray]
) -> None:
    assert len(drives) == len(driven)
    for drive, of, true in zip(drives, driven, truth, strict=True):
        assert drive.poses.shape == (len(of.loop.keyframes), 3)
        assert np.hypot(*(drive.poses - true[of.loop.keyframes])[:, :2].T).max() < 0.1
        assert drive.part == 5


def test_its_scans_are_those_of_the_run(drives: list[PlacedDrive], driven: list[DrivenRun]) -> None:
    for drive, of in zip(drives, driven, strict=True):
        assert len(drive.scans) == len(of.loop.keyframes)
        passed = np.searchsorted(of.loop.keyframes, [found.centre for found in of.passes]).tolist()
        for row in (0, 1, *passed, *(k + 1 for k in passed), len(drive.scans) - 1):
            np.testing.assert_array_equal(drive.scans[row].points, of.loop.scans[row].points)
        assert len(drive.scans[3:9:2]) == 3


def test_every_pass_is_there_once_where_the_tag_was_read(
    solved: Solved, drives: list[PlacedDrive], driven: list[DrivenRun], truth: list[np.ndarray]
) -> None:
    graph, pieces = solved
    passes = find_tag_passes(pieces, find_boundary(pieces), graph)
    expected = [(run, found.centre) for run, of in enumerate(driven) for found in of.passes]
    assert [(of.drive, int(driven[of.drive].loop.keyframes[of.index])) for of in passes] == expected
    assert len({of.variable for of in passes}) == len(passes)
    for of, (run, centre) in zip(passes, expected, strict=True):
        assert graph.nodes[of.node].epc == next(p.epc for p in driven[run].passes if p.centre == centre)
        assert of.reach_m > 0
        assert np.hypot(*(drives[run].passing(of).pose - truth[run][centre])[:2]) < 0.1


def test_pieces_moved_together_move_their_drives(
    solved: Solved, frames: list[np.ndarray], drives: list[PlacedDrive]
) -> None:
    moved = np.array([100.0, -40.0, 1.0])
    again = place_drives(solved[1], [compose(moved, frame) for frame in frames], [0] * len(frames))
    for one, other in zip(drives, again, strict=True):
        np.testing.assert_allclose(compose(moved, one.poses)[:, :2], other.poses[:, :2], atol=1e-9)
