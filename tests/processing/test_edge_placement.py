"""The refined assembly of the small mine, with and without noise: against the truth, in parts, and contradicted."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import shapely
from numpy.testing import assert_allclose

from processing.boundary import find_boundary
from processing.edge_placement import Placed, Placement, edge_frame, lay_side_by_side, place_by_frames
from processing.geometry import compose, relative, transform, wrap_angle
from processing.graph import Graph
from processing.length_placement import place_by_lengths
from processing.occupancy_grid import Grid
from processing.pieces import SolvedPiece, draw_piece
from processing.pipeline import DrivenRun, remarks
from processing.scan_matching import Matcher, match_scans
from processing.workers import Workers

Solve = Callable[[list[DrivenRun]], tuple[Graph, list[SolvedPiece]]]
Move = Callable[[list[Placed], list[DrivenRun]], tuple[np.ndarray, np.ndarray]]
Solved = tuple[Graph, list[SolvedPiece]]
Place = Callable[[list[SolvedPiece], Graph, Matcher, Workers], Placement]


def occupied(grid: Grid) -> np.ndarray:
    """Centres (n, 2) of the cells that are more likely wall than not."""
    rows, columns = np.nonzero(grid.log_odds > 0.5)
    return grid.origin + grid.resolution_m * (np.column_stack([columns, rows]) + 0.5)


def renamed(of: DrivenRun) -> DrivenRun:
    """The run with tags that no other run has."""
    return replace(of, passes=[replace(found, epc=found.epc.replace("E2003412", "E2009999")) for found in of.passes])


def place_anew(pieces: list[SolvedPiece], graph: Graph, match: Matcher, work: Workers) -> Placement:
    return place_by_frames(pieces, graph, match, work, known={})


@pytest.fixture(scope="module")
def placement(solved: Solved) -> Placement:
    graph, pieces = solved
    return place_anew(pieces, graph, match_scans, Workers(1))


def test_walls_are_stitched_within_two_cells_of_the_true_ones(
    driven_clean: list[DrivenRun], solve_runs: Solve, move_into_world: Move, small_world: Path
) -> None:
    """Without noise, all pieces drawn where they were placed: no cell of a wall further off than that."""
    graph, solved = solve_runs(driven_clean)
    placement = place_anew(solved, graph, match_scans, Workers(1))
    into_world, off = move_into_world(placement.pieces, driven_clean)
    assert off.max() < 0.03
    walls = np.loadtxt(small_world / "walls.csv", delimiter=",", skiprows=1)
    true = shapely.multilinestrings(walls.reshape(-1, 2, 2))
    cells = []
    for piece in placement.pieces:
        grid = draw_piece(piece.solved.input, piece.solved.map.firsts, piece.edge_poses, 0.05)
        cells.append(transform(compose(into_world, piece.frame), occupied(grid)))
    cells = np.concatenate(cells)
    shapely.prepare(true)
    from_wall = shapely.distance(shapely.points(cells), true)
    assert len(cells) > 5_000
    assert np.mean(from_wall <= 0.1) > 0.999
    assert np.mean(from_wall <= 0.05) > 0.9


def test_with_noise_the_loop_closes(placement: Placement, driven: list[DrivenRun], move_into_world: Move) -> None:
    """The wheels are off by a percent, and the chain of edges meets its own beginning."""
    _, off = move_into_world(placement.pieces, driven)
    assert {piece.part for piece in placement.pieces} == {0}
    assert placement.remarks == []
    assert np.sqrt(np.mean(off**2)) < 0.03
    assert off.max() < 0.08


def test_neighbours_agree_where_they_share_a_pass(placement: Placement) -> None:
    at: dict[tuple[int, int], list[np.ndarray]] = {}
    for piece in placement.pieces:
        for k, span in enumerate(piece.solved.input.piece.spans):
            for index, scan in zip(piece.solved.ends(k), (span.first, span.last), strict=True):
                at.setdefault((span.run, scan), []).append(piece.poses[index])
    shared = [poses for poses in at.values() if len(poses) == 2]
    assert len(shared) >= 8
    for a, b in shared:
        assert_allclose(a[:2], b[:2], atol=1e-6)
        assert abs(wrap_angle(a[2] - b[2])) < 1e-6


def test_drives_both_ways_are_one_edge_and_lie_over_each_other(
    placement: Placement, driven: list[DrivenRun], true_keyframes: Callable[[SolvedPiece, list[DrivenRun]], np.ndarray]
) -> None:
    tried = 0
    for placed in placement.pieces:
        spans = placed.solved.input.piece.spans
        other = next((k for k, span in enumerate(spans) if span.start == spans[0].end), None)
        if placed.solved.input.piece.j is None or other is None:
            continue
        true, i, k = true_keyframes(placed.solved, driven), placed.solved.ends(0)[0], placed.solved.ends(other)[1]
        error = relative(relative(true[i], true[k]), relative(placed.poses[i], placed.poses[k]))
        assert abs(wrap_angle(relative(true[i], true[k])[2])) > 2.5
        assert np.hypot(*error[:2]) < 0.05
        assert abs(error[2]) < np.radians(0.5)
        tried += 1
    assert tried


def test_frames_lie_at_the_lower_node_and_point_to_the_other(placement: Placement) -> None:
    for piece in placement.pieces:
        i, j = piece.solved.input.piece.i, piece.solved.input.piece.j
        assert_allclose(piece.frame[:2], placement.nodes[i, :2])
        if j is not None:
            far = relative(piece.frame, placement.nodes[j])
            assert_allclose(far[1], 0, atol=1e-9)
            assert far[0] > 5
        passes = [index for k in range(len(piece.solved.input.paths)) for index in piece.solved.ends(k)]
        assert np.hypot(*(piece.poses[passes, :2] - placement.nodes[i, :2]).T).min() < 2.0


def test_runs_without_a_common_tag_are_parts_side_by_side(
    driven: list[DrivenRun], solve_runs: Solve, move_into_world: Move
) -> None:
    """The same mine, but the second run read other tags: nothing may be joined, and the user is told."""
    runs = [driven[0], renamed(driven[1])]
    graph, pieces = solve_runs(runs)
    placement = place_anew(pieces, graph, match_scans, Workers(1))
    assert len(placement.remarks) == 1
    assert "2 unconnected parts" in placement.remarks[0]
    assert "run small-back shares no tag with the others: it is mapped alone" in remarks(runs, placement)
    told = "run small-back saw no walls like the others' at the tags that they share: it is mapped alone"
    assert told in remarks(driven, placement)  # the same, had they been the same tags
    extents = []
    for part, run in ((0, 0), (1, 1)):
        members = [piece for piece in placement.pieces if piece.part == part]
        assert {span.run for piece in members for span in piece.solved.input.piece.spans} == {run}
        assert move_into_world(members, driven)[1].max() < 0.1
        x = np.concatenate([piece.poses[:, 0] for piece in members])
        extents.append((x.min(), x.max()))
        for node in np.flatnonzero(placement.node_parts == part):
            assert extents[-1][0] <= placement.nodes[node, 0] <= extents[-1][1]
    assert extents[1][0] - extents[0][1] > 39.9  # neither do their scans meet
    assert sorted(placement.node_parts.tolist()) == [0] * 4 + [1] * (len(graph.nodes) - 4)


@pytest.mark.parametrize(("place", "most_m"), [(place_anew, 0.1), (place_by_lengths, 0.8)])
@pytest.mark.parametrize(("other", "tag"), [(0, 0), (1, 1)])
def test_a_run_that_shares_one_tag_hangs_on_the_map_there(
    driven: list[DrivenRun], solve_runs: Solve, move_into_world: Move, other: int, tag: int, place: Place, most_m: float
) -> None:
    """No drive joins the two runs, only their scans at the one tag that both passed."""
    epc = sorted({found.epc for found in driven[0].passes})[tag]
    one = next(found for found in driven[other].passes if found.epc == epc)
    graph, pieces = solve_runs([replace(of, passes=[one]) if k == other else of for k, of in enumerate(driven)])
    placement = place(pieces, graph, match_scans, Workers(1))
    assert {piece.part for piece in placement.pieces} == {0}
    assert placement.remarks == []
    assert move_into_world(placement.pieces, driven)[1].max() < most_m


def test_a_run_without_tags_is_mapped_alone_and_told(
    driven: list[DrivenRun], solve_runs: Solve, move_into_world: Move
) -> None:
    runs = [driven[0], replace(driven[1], passes=[])]
    graph, pieces = solve_runs(runs)
    placement = place_anew(pieces, graph, match_scans, Workers(1))
    (alone,) = [piece for piece in placement.pieces if piece.solved.input.piece.i is None]
    assert [piece.part for piece in placement.pieces if piece is not alone] == [1 - alone.part] * (len(pieces) - 1)
    assert move_into_world([alone], driven)[1].max() < 0.1
    said = remarks(runs, placement)
    assert "run small-back passed 0 tags: it is mapped alone" in said
    assert any("2 unconnected parts" in remark for remark in said)


def test_no_run_with_a_tag_still_makes_a_map(driven: list[DrivenRun], solve_runs: Solve) -> None:
    graph, pieces = solve_runs([replace(driven[1], passes=[])])
    placement = place_anew(pieces, graph, match_scans, Workers(1))
    assert graph.nodes == ()
    assert placement.nodes.shape == (0, 3)
    (alone,) = placement.pieces
    assert_allclose(alone.edge_poses[0], 0, atol=1e-12)
    assert placement.remarks == []


def test_a_stretched_piece_gives_way_to_its_neighbours(
    solved: Solved, driven: list[DrivenRun], move_into_world: Move
) -> None:
    """A drift in the ring that is a twentieth too long and unsure of it: all else keeps its shape."""
    graph, pieces = solved
    chosen = next(k for k, piece in enumerate(pieces) if piece.input.piece.j is not None)
    piece = pieces[chosen]
    weak = replace(piece.map.links, informations=piece.map.links.informations * 1e-4)
    first = piece.map.poses[0]
    poses = piece.map.poses.copy()
    poses[:, :2] = first[:2] + 1.05 * (poses[:, :2] - first[:2])
    ends = weak.ends
    stretched = replace(weak, motions=relative(poses[ends[:, 0]], poses[ends[:, 1]]))
    bent = replace(piece, map=replace(piece.map, poses=poses, links=stretched))
    placement = place_anew([*pieces[:chosen], bent, *pieces[chosen + 1 :]], graph, match_scans, Workers(1))
    stretch = np.hypot(*(poses - piece.map.poses)[:, :2].T).max()
    assert stretch > 0.5
    others = [placed for placed in placement.pieces if placed.solved.input is not piece.input]
    assert move_into_world(others, driven)[1].max() < 0.15
    assert move_into_world(placement.pieces, driven)[1].max() < 0.6 * stretch


def test_passes_are_variables_shared_by_the_pieces_around_them(solved: Solved) -> None:
    _, pieces = solved
    boundary = find_boundary(pieces)
    holders = [p for p, of in enumerate(boundary.variables) for _ in set(of)]
    assert len(holders) > boundary.count
    assert boundary.count == len(boundary.passes) == len(boundary.nodes)
    known = boundary.variables[0][0]
    assert boundary.add(0, boundary.indices[0][0]) == known
    assert boundary.add(0, 3) == boundary.count - 1 == len(boundary.passes)
    assert boundary.add(0, 3) == len(boundary.passes)


@pytest.mark.parametrize("parts", [[0, 0, 1, 2], [0, 1, 2, 1]])
def test_side_by_side_leaves_the_first_part_where_it_is(parts: list[int]) -> None:
    rng = np.random.default_rng(1)
    poses = [rng.uniform(-50, 50, (30, 3)) for _ in parts]
    shifts = lay_side_by_side(poses, parts)
    assert shifts[0] == 0
    low = [min((of[:, 0] + shifts[p]).min() for of, q in zip(poses, parts, strict=True) if q == p) for p in range(3)]
    high = [max((of[:, 0] + shifts[p]).max() for of, q in zip(poses, parts, strict=True) if q == p) for p in range(3)]
    assert low[1] - high[0] > 39.9
    assert low[2] - high[1] > 39.9


def test_edge_frame_of_a_run_alone_is_its_first_pose(solved: Solved) -> None:
    piece = solved[1][0]
    alone = replace(piece, input=replace(piece.input, piece=replace(piece.input.piece, i=None, j=None)))
    poses = np.array([[1.0, 2.0, 3.0], [2.0, 2.0, 3.0]])
    assert_allclose(edge_frame(alone, np.zeros((0, 3)), poses), poses[0])
