"""Paths that no scan joins: placed by what joins them elsewhere, however wrong the tags had them at first."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from processing.edge_placement import Placed, place_by_frames
from processing.geometry import compose, inverse
from processing.graph import Graph
from processing.linked_paths import join_groups, merge_groups, split_groups
from processing.pieces import SolvedPiece
from processing.pipeline import DrivenRun
from processing.scan_matching import match_scans
from processing.workers import Workers

TURN_RAD = 1.0


def torn(piece: SolvedPiece) -> SolvedPiece:
    """The piece with its last path turned about its own beginning, and no scan that says otherwise."""
    found, last = piece.map, len(piece.input.paths) - 1
    path = np.searchsorted(found.firsts, found.links.ends, side="right") - 1
    kept = np.flatnonzero(((path == last).sum(axis=1) != 1) | ~found.links.robust)
    poses, turned = found.poses.copy(), found.path(last)
    start = poses[turned][0]
    poses[turned] = compose(compose(start, np.array([0.0, 0.0, TURN_RAD])), compose(inverse(start), poses[turned]))
    solution = replace(
        found.solution,
        poses=poses,
        weights=found.solution.weights[kept],
        squared_distances=found.solution.squared_distances[kept],
    )
    return replace(piece, map=replace(found, poses=poses, links=found.links[kept], solution=solution))


@pytest.fixture
def with_one_torn(solved: tuple[Graph, list[SolvedPiece]]) -> tuple[list[SolvedPiece], int]:
    """The pieces of the small mine, and which of them is torn."""
    _, pieces = solved
    which = next(p for p, piece in enumerate(pieces) if len(piece.input.paths) > 1)
    return [torn(piece) if p == which else piece for p, piece in enumerate(pieces)], which


def test_pieces_hang_together_but_for_what_is_torn(with_one_torn: tuple[list[SolvedPiece], int]) -> None:
    pieces, which = with_one_torn
    groups = split_groups(pieces)
    assert [group.piece for group in groups] == sorted([*range(len(pieces)), which])
    first, second = (group for group in groups if group.piece == which)
    assert_allclose(np.concatenate([first.rows, second.rows]), np.arange(len(pieces[which].map.poses)))
    assert len(second.solved.input.paths) == 1
    for group in (first, second):
        assert_allclose(group.solved.map.poses, pieces[which].map.poses[group.rows])
        assert group.solved.map.links.ends.max() == len(group.rows) - 1
        assert len(group.solved.map.links) == len(group.solved.map.solution.weights)
    whole = merge_groups(pieces, groups, [group.solved for group in groups])
    for piece, merged in zip(pieces, whole, strict=True):
        assert_allclose(merged.map.poses, piece.map.poses)


def test_both_tags_join_what_is_torn(with_one_torn: tuple[list[SolvedPiece], int]) -> None:
    pieces, which = with_one_torn
    groups = split_groups(pieces)
    joins = join_groups(groups)
    assert [groups[g].piece for join in joins for g in join.groups] == [which] * 4
    for join in joins:
        at = [groups[g].solved.map.poses[index] for g, index in zip(join.groups, join.indices, strict=True)]
        assert_allclose(np.abs(compose(at[0], join.motion) - at[1]), 0.0, atol=1e-9)
    nodes = {(groups[j.groups[0]].solved.input.piece.i, groups[j.groups[0]].solved.input.piece.j) for j in joins}
    assert len(joins) == 2
    assert len(nodes) == 1


def test_a_wrong_turn_between_unjoined_paths_bends_nothing(
    with_one_torn: tuple[list[SolvedPiece], int],
    solved: tuple[Graph, list[SolvedPiece]],
    driven: list[DrivenRun],
    move_into_world: Callable[[list[Placed], list[DrivenRun]], tuple[np.ndarray, np.ndarray]],
) -> None:
    """Taken for one rigid piece, to first order, its paths would come out sheared by metres."""
    placement = place_by_frames(with_one_torn[0], solved[0], match_scans, Workers(1), known={})
    assert {piece.part for piece in placement.pieces} == {0}
    assert move_into_world(placement.pieces, driven)[1].max() < 0.1
