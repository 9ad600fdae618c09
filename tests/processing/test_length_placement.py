"""The paper's assembly of the small mine: lengths kept, turns fitted, spurs hung on, contradictions named."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from processing.edge_placement import Placed, Placement
from processing.geometry import compose, inverse, relative, wrap_angle
from processing.graph import Graph
from processing.length_placement import _find_hold, place_by_lengths
from processing.pieces import SolvedPiece
from processing.pipeline import DrivenRun
from processing.scan_matching import match_scans
from processing.workers import Workers

Solve = Callable[[list[DrivenRun]], tuple[Graph, list[SolvedPiece]]]
Move = Callable[[list[Placed], list[DrivenRun]], tuple[np.ndarray, np.ndarray]]
Solved = tuple[Graph, list[SolvedPiece]]


def length(poses: np.ndarray, piece: SolvedPiece) -> float:
    """Between the passes at the ends of the first path: the length of an edge (paper, figure 6c)."""
    a, b = piece.ends(0)
    return float(np.hypot(*(poses[b] - poses[a])[:2]))


def scale(piece: SolvedPiece, by: float) -> SolvedPiece:
    """The piece as a drive up a slope would have it: longer than its shadow on the plane."""
    poses = piece.map.poses.copy()
    poses[:, :2] *= by
    return replace(piece, map=replace(piece.map, poses=poses))


@pytest.fixture(scope="module")
def placement(solved: Solved) -> Placement:
    graph, pieces = solved
    return place_by_lengths(pieces, graph, match_scans, Workers(1))


def test_all_pieces_hang_together_where_they_truly_lie(
    placement: Placement, driven: list[DrivenRun], move_into_world: Move
) -> None:
    """Errors show as kinks at the nodes, so less exactly than in the refined assembly."""
    assert {piece.part for piece in placement.pieces} == {0}
    assert np.all(placement.node_parts == 0)
    _, off = move_into_world(placement.pieces, driven)
    assert np.sqrt(np.mean(off**2)) < 0.15
    assert off.max() < 0.5


def test_without_noise_the_kinks_are_gone(
    driven_clean: list[DrivenRun], solve_runs: Solve, move_into_world: Move
) -> None:
    graph, pieces = solve_runs(driven_clean)
    placement = place_by_lengths(pieces, graph, match_scans, Workers(1))
    assert placement.remarks == []
    _, off = move_into_world(placement.pieces, driven_clean)
    assert off.max() < 0.15


def test_pieces_keep_their_shape_and_edges_their_length(placement: Placement, solved: Solved) -> None:
    for placed, piece in zip(placement.pieces, solved[1], strict=True):
        assert placed.solved is piece
        shape = relative(piece.map.poses[0], piece.map.poses)
        kept = relative(placed.edge_poses[0], placed.edge_poses)
        assert_allclose(kept[:, :2], shape[:, :2], atol=1e-9)
        assert_allclose(wrap_angle(kept[:, 2] - shape[:, 2]), 0, atol=1e-9)
        i, j = piece.input.piece.i, piece.input.piece.j
        if j is not None:
            apart = np.hypot(*(placement.nodes[j] - placement.nodes[i])[:2])
            assert apart == pytest.approx(length(piece.map.poses, piece), abs=1.0)


def test_edge_frames_run_from_node_to_node(placement: Placement) -> None:
    """Figure 6c: the pass of the lower node at the origin, that of the other on the x-axis, either way driven."""
    backwards = 0
    for placed in placement.pieces:
        piece = placed.solved.input.piece
        if piece.j is None:
            continue
        ends = placed.edge_poses[list(placed.solved.ends(0))]
        if piece.spans[0].start != piece.i:
            ends, backwards = ends[::-1], backwards + 1
        assert_allclose(ends[0, :2], 0, atol=1e-9)
        assert_allclose(ends[1, 1], 0, atol=1e-9)
        assert ends[1, 0] > 5
    assert backwards > 0


def test_a_drive_goes_on_from_piece_to_piece(placement: Placement) -> None:
    """Both sides of a pass are one pose of one drive: what is between them is the kink."""
    at: dict[tuple[int, int], list[np.ndarray]] = {}
    for placed in placement.pieces:
        for k, span in enumerate(placed.solved.input.piece.spans):
            for index, scan in zip(placed.solved.ends(k), (span.first, span.last), strict=True):
                at.setdefault((span.run, scan), []).append(placed.poses[index])
    kinks = np.array([relative(*poses) for poses in at.values() if len(poses) == 2])
    assert len(kinks) >= 8
    assert np.hypot(*kinks[:, :2].T).max() < 0.6
    assert np.abs(kinks[:, 2]).max() < np.radians(3)


def test_a_length_that_cannot_hold_is_named(
    solved: Solved, placement: Placement, driven: list[DrivenRun], move_into_world: Move
) -> None:
    """An incline of a third inside the ring of four edges: no layout in the plane has all four lengths."""
    graph, pieces = solved
    assert placement.remarks == []
    edges = [k for k, piece in enumerate(pieces) if piece.input.piece.j is not None]
    longest = max(edges, key=lambda k: length(pieces[k].map.poses, pieces[k]))
    others = sum(length(pieces[k].map.poses, pieces[k]) for k in edges if k != longest)
    steep = [scale(p, 2 * others / length(p.map.poses, p)) if k == longest else p for k, p in enumerate(pieces)]
    (remark,) = place_by_lengths(steep, graph, match_scans, Workers(1)).remarks
    assert pieces[longest].input.name in remark
    assert "cannot all hold" in remark


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_tags_on_one_bolt_bend_nothing(
    driven: list[DrivenRun], solve_runs: Solve, move_into_world: Move, seed: int
) -> None:
    """Each tag has another beside it; the centres of both clouds lie where they like within a metre of it."""
    rng, doubled = np.random.default_rng(seed), []
    for of in driven:
        passes = []
        for found in of.passes:
            at = int(np.searchsorted(of.loop.keyframes, found.centre))
            for beside, shift in zip(("", "B"), rng.choice([-1, 0, 1], 2, replace=False), strict=True):
                passes.append(replace(found, epc=found.epc + beside, centre=int(of.loop.keyframes[at + shift])))
        doubled.append(replace(of, passes=sorted(passes, key=lambda found: found.centre)))
    graph, pieces = solve_runs(doubled)
    assert len(graph.nodes) == 8
    placement = place_by_lengths(pieces, graph, match_scans, Workers(1))
    assert {piece.part for piece in placement.pieces} == {0}
    _, off = move_into_world(placement.pieces, driven)
    assert np.sqrt(np.mean(off**2)) < 1.0


def test_runs_without_a_common_tag_are_parts_side_by_side_and_told(
    driven: list[DrivenRun], solve_runs: Solve, move_into_world: Move
) -> None:
    passes = [replace(found, epc=found.epc.replace("E2003412", "E2009999")) for found in driven[1].passes]
    graph, pieces = solve_runs([driven[0], replace(driven[1], passes=passes)])
    placement = place_by_lengths(pieces, graph, match_scans, Workers(1))
    spans = [{span.run for span in piece.solved.input.piece.spans} for piece in placement.pieces]
    assert [{piece.part} for piece in placement.pieces] == spans  # run 0 is part 0, run 1 part 1
    assert any("2 unconnected parts" in remark for remark in placement.remarks)
    x = [np.concatenate([piece.poses[:, 0] for piece in placement.pieces if piece.part == part]) for part in (0, 1)]
    assert x[1].min() - x[0].max() > 39.9
    for part in (0, 1):
        assert move_into_world([p for p in placement.pieces if p.part == part], driven)[1].max() < 0.5


def test_a_run_with_one_tag_is_one_part(driven: list[DrivenRun], solve_runs: Solve, move_into_world: Move) -> None:
    """Three spurs in a row, no edge at all: each hangs on the one before it."""
    one = [found for found in driven[0].passes if found.epc == driven[0].passes[0].epc]
    assert len(one) == 2
    graph, pieces = solve_runs([replace(driven[0], passes=one)])
    assert len(pieces) == 3
    placement = place_by_lengths(pieces, graph, match_scans, Workers(1))
    assert {piece.part for piece in placement.pieces} == {0}
    assert placement.remarks == []
    assert move_into_world(placement.pieces, driven)[1].max() < 1.0
    assert_allclose(placement.nodes[0, :2], placement.pieces[0].poses[-1, :2], atol=1.0)


def test_a_run_without_tags_is_placed_alone(driven: list[DrivenRun], solve_runs: Solve) -> None:
    graph, pieces = solve_runs([replace(driven[1], passes=[])])
    placement = place_by_lengths(pieces, graph, match_scans, Workers(1))
    assert placement.nodes.shape == (0, 3)
    assert [piece.part for piece in placement.pieces] == [0]
    assert_allclose(placement.pieces[0].edge_poses[0], 0, atol=1e-12)


def test_a_link_holds_a_spur_from_either_end(solved: Solved) -> None:
    spur = next(piece for piece in solved[1] if piece.input.piece.j is None)
    span = spur.input.piece.spans[0]
    own, index = ((span.run, span.last), 1) if span.end is not None else ((span.run, span.first), 0)
    known, there, motion = (7, 100), np.array([5.0, -3.0, 2.0]), np.array([0.8, 0.3, 1.0])
    for link in ((known, own, motion), (own, known, inverse(motion))):
        hold = _find_hold(spur, {known: (there, 2)}, [link])
        assert hold is not None
        assert_allclose(hold[0], compose(there, motion))
        assert hold[1:] == (2, spur.ends(0)[index])
    assert _find_hold(spur, {known: (there, 2)}, []) is None
