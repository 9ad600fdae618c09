"""Closed-loop pieces of the small mine: nearer to the truth than open loop, and not to be bent by lies."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from processing.edge_map import (
    MAX_DRIFT_M,
    MAX_DRIFT_RAD,
    Drift,
    Path,
    map_piece,
    solve_present,
)
from processing.geometry import accumulate, align, compose, relative, wrap_angle
from processing.graph import Graph
from processing.pieces import SolvedPiece
from processing.pipeline import DrivenRun
from processing.pose_graph import Links
from processing.scan_match import ScanMatch
from processing.scan_matching import match_scans
from processing.scan_walls import Scan
from processing.strong_links import (
    FIRST_DRIVES,
    LOOP_SPACING_M,
    MOST_LOOPS,
    KeyFrames,
    hop_pairs,
    loop_pairs,
    worth_a_link,
)

Solved = tuple[Graph, list[SolvedPiece]]
Truth = Callable[[SolvedPiece, list[DrivenRun]], np.ndarray]


def off(poses: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """How far (N,) m the poses are off, moved as one."""
    return np.hypot(*(compose(align(poses[:, :2], truth[:, :2]), poses) - truth)[:, :2].T)


def whole_run(of: DrivenRun) -> Path:
    loop = of.loop
    return Path(of.run.run_id, np.arange(len(loop.keyframes)), loop.scans, loop.links, loop.wheels, np.zeros(3))


def beginning(of: Path, count: int) -> Path:
    """Its first key frames."""
    rows = np.arange(count - 1)
    return replace(
        of, scans=of.scans[:count], keyframes=of.keyframes[:count], chain=of.chain[rows], wheels=of.wheels[rows]
    )


def turn_aside(path: Path, at: int, radians: float) -> Path:
    """The path with one link of its chain turned, as by a wrong match in a bend; the wheels are right about it."""
    motions = path.chain.motions.copy()
    motions[at, 2] += radians
    return replace(path, chain=replace(path.chain, motions=motions))


def frames_along(x: np.ndarray, drive: np.ndarray) -> KeyFrames:
    """Key frames without scans, for what is chosen by place alone."""
    return KeyFrames([], drive, x, np.zeros((len(x), 3)), match_scans)


def test_a_run_that_meets_its_own_beginning_closes(driven: list[DrivenRun], truth: list[np.ndarray]) -> None:
    """Without any tag: a loop of 140 m and half of it again."""
    path, true = whole_run(driven[0]), truth[0][driven[0].loop.keyframes]
    piece = map_piece([path], match_scans)
    open_loop = accumulate(np.zeros(3), path.chain.motions)
    assert off(piece.poses, true).max() < 0.08
    assert off(piece.poses, true).max() < 0.5 * off(open_loop, true).max()
    ends = piece.links.ends[piece.links.robust]
    way = np.append(0.0, np.cumsum(np.hypot(*path.chain.motions[:, :2].T)))
    assert np.sum(np.abs(np.diff(way[ends], axis=1)) > 100) > 10
    assert piece.solution.converged
    assert_allclose(piece.poses[0], 0, atol=1e-9)


def test_a_chain_with_a_wrong_turn_is_mended(driven: list[DrivenRun], truth: list[np.ndarray]) -> None:
    """The wheels, and hops over the fault, outvote it: it does not bend the drift, nor keep the loop from closing."""
    path, true = whole_run(driven[0]), truth[0][driven[0].loop.keyframes]
    astray = turn_aside(path, 60, 0.2)
    bent = off(accumulate(np.zeros(3), astray.chain.motions), true).max()
    piece = map_piece([astray], match_scans)
    assert bent > 2.0
    assert off(piece.poses, true).max() < 0.1
    assert not np.any(np.all(piece.links.ends == [60, 61], axis=1) & piece.links.robust)  # the liar is gone


@pytest.mark.parametrize("seed", [0, 1])
def test_strong_links_that_lie_bend_nothing(driven: list[DrivenRun], truth: list[np.ndarray], seed: int) -> None:
    """One match in seven is off by up to a metre and half a radian, and sure of itself."""
    rng = np.random.default_rng(seed)

    def liar(reference: Scan, current: Scan, guess: np.ndarray) -> ScanMatch:
        found = match_scans(reference, current, guess)
        lie = rng.uniform(-1, 1, 3) * [1, 1, 0.5] if rng.random() < 1 / 7 else np.zeros(3)
        return replace(found, motion=found.motion + lie)

    path, true = whole_run(driven[0]), truth[0][driven[0].loop.keyframes]
    piece = map_piece([path], liar)
    assert off(piece.poses, true).max() < 0.12


def test_paths_of_an_edge_lie_over_each_other_whichever_way_they_were_driven(
    solved: Solved, driven: list[DrivenRun], true_keyframes: Truth
) -> None:
    """Strong links join them; the relative pose between any two key frames is right to centimetres."""
    both_ways = 0
    for piece in solved[1]:
        paths = len(piece.input.paths)
        if paths < 2:
            continue
        true, firsts = true_keyframes(piece, driven), piece.map.firsts
        assert off(piece.map.poses, true).max() < 0.05
        ends = piece.map.links.ends[piece.map.links.robust]
        across = np.searchsorted(firsts, ends, side="right")
        assert np.sum(across[:, 0] != across[:, 1]) >= 5 * (paths - 1)
        i, k = firsts[0], firsts[1] - 1
        for p in range(1, paths):
            j = piece.map.path(p).start
            error = relative(relative(true[i], true[j]), relative(piece.map.poses[i], piece.map.poses[j]))
            assert np.hypot(*error[:2]) < 0.05
            assert abs(error[2]) < np.radians(0.5)
            headings = true[piece.map.path(p), 2][:, None] - true[i : k + 1, 2]
            both_ways += (
                np.abs(wrap_angle(headings)).min() > 1.0
                or piece.input.piece.spans[p].start != piece.input.piece.spans[0].start
            )
    assert both_ways


@pytest.mark.parametrize("error", [(1.5, -1.0, 0.0), (-2.0, 1.5, 0.25)])
def test_a_poor_start_of_a_second_path_is_made_good(
    solved: Solved, driven: list[DrivenRun], true_keyframes: Truth, error: tuple[float, float, float]
) -> None:
    """As where no scan told where the tag was passed."""
    piece = next(piece for piece in solved[1] if len(piece.input.paths) > 1)
    first, second = piece.input.paths[:2]
    poor = replace(second, start=compose(second.start, np.array(error)))
    found = map_piece([first, poor], match_scans)
    assert off(found.poses, true_keyframes(piece, driven)[: len(found.poses)]).max() < 0.06


def test_two_key_frames_are_a_piece(driven: list[DrivenRun]) -> None:
    """The shortest spur: from the start of a run to a tag beside it."""
    loop = driven[0].loop
    path = Path("short", np.arange(2), loop.scans[:2], loop.links[np.arange(1)], loop.wheels[np.arange(1)], np.zeros(3))
    piece = map_piece([path], match_scans)
    assert piece.firsts.tolist() == [0, 2]
    gap = relative(piece.poses[0], piece.poses[1]) - loop.links.motions[0]
    assert np.hypot(*gap[:2]) < 0.01


def test_a_blind_scanner_leaves_the_wheels(driven: list[DrivenRun]) -> None:
    """No scan holds anything: the piece is what odometry makes of it, and no link is invented."""
    loop = driven[0].loop
    blind = replace(loop.scans[0], points=np.full((541, 2), np.nan), normals=np.full((541, 2), np.nan))
    path = whole_run(driven[0])
    wheels = Links(path.wheels.ends, path.wheels.motions, path.wheels.informations, np.ones(len(path.wheels), bool))
    piece = map_piece([replace(path, scans=[blind] * len(loop.scans), chain=wheels)], match_scans)
    assert_allclose(piece.poses[:, :2], accumulate(np.zeros(3), path.wheels.motions)[:, :2], atol=1e-3)
    assert len(piece.links) == 2 * len(path.wheels)


def test_a_drive_strays_further_the_longer_it_goes(driven: list[DrivenRun]) -> None:
    chain, drift, radii = driven[0].loop.links, Drift(), [0.0]
    assert drift.radius_m == drift.radius_rad == 0
    for first in range(0, 180, 20):
        drift = drift.after(chain[np.arange(first, first + 20)])
        radii.append(drift.radius_m)
    assert np.all(np.diff(radii) > 0)
    whole = Drift().after(chain[np.arange(180)])
    assert drift.radius_m == pytest.approx(whole.radius_m, rel=0.05)  # in parts or at once
    assert drift.radius_rad == pytest.approx(whole.radius_rad)
    hopeless = Drift(1e6, 1e6)
    assert (hopeless.radius_m, hopeless.radius_rad) == (MAX_DRIFT_M, MAX_DRIFT_RAD)


def test_hops_join_what_lies_metres_apart_on_one_drive() -> None:
    way = np.concatenate([np.arange(0, 12, 0.75), np.arange(0, 12, 0.75)])
    drive = np.repeat([0, 1], 16)
    pairs = hop_pairs(frames_along(way, drive), [0, 1])
    assert np.all(drive[pairs[:, 0]] == drive[pairs[:, 1]])
    hops = way[pairs[:, 1]] - way[pairs[:, 0]]
    assert np.all(np.min(np.abs(hops[:, None] - [2.0, 4.0, 8.0]), axis=1) < 0.76)
    assert len(np.unique(pairs, axis=0)) == len(pairs)
    assert len(hop_pairs(frames_along(np.arange(2.0), np.zeros(2, np.int64)), [0])) == 0
    assert set(drive[hop_pairs(frames_along(way, drive), [1])].ravel().tolist()) == {1}


def test_loops_join_drives_that_are_near_and_a_drive_with_its_past() -> None:
    """Out 30 m and back on the same line: neighbours in time are no loop, and each stretch gives its nearest."""
    x = np.concatenate([np.arange(0, 30, 1.0), np.arange(30, 0, -1.0)])
    frames = frames_along(np.arange(60.0), np.zeros(60, np.int64))
    poses, everything = np.column_stack([x, np.zeros(60), np.zeros(60)]), np.arange(60)
    pairs = loop_pairs(frames, poses, everything, everything, 2.5)
    assert np.all(np.abs(np.diff(pairs, axis=1)) > LOOP_SPACING_M)
    assert np.all(np.abs(x[pairs[:, 0]] - x[pairs[:, 1]]) <= 2.5)
    assert np.mean(x[pairs[:, 0]] == x[pairs[:, 1]]) > 0.9  # but where it turned, and the nearest is too near in time
    assert {55, 5} <= set(pairs[:, 1].tolist())
    both = frames_along(np.arange(60.0) % 30, np.repeat([0, 1], 30))
    assert np.any(np.all(loop_pairs(both, poses, everything[30:], everything[:30], 2.5) == [29, 31], axis=1))
    assert len(loop_pairs(frames, poses, everything, everything[:0], 2.5)) == 0


def test_later_drives_are_linked_to_the_first_where_those_were() -> None:
    """Eleven drives over one place; the first four turned off before its second half."""
    drives, count = FIRST_DRIVES + 5, 10
    drive, x = np.repeat(np.arange(drives), count), np.tile(np.arange(count) * 1.0, drives)
    frames = frames_along(x, drive)
    y = np.where((drive < 4) & (x > 4), 50.0, 0.01 * drive)
    pairs = loop_pairs(frames, np.column_stack([x, y, 0 * x]), np.arange(len(x)), np.arange(len(x)), 0.5)
    partners = {int(i): set(drive[pairs[pairs[:, 1] == i, 0]].tolist()) for i in pairs[:, 1]}
    last = (drives - 1) * count
    assert partners[last + 2] == {2, 3, 4, 5}  # of the first six, the nearest
    assert partners[last + 7] == {4, 5, 8, 9}  # the two of them that came here, and the nearest of the others
    assert max(len(of) for of in partners.values()) == MOST_LOOPS


def test_a_match_that_says_nothing_is_no_link() -> None:
    sure = ScanMatch(np.zeros(3), np.diag([1e-4, 1e-4, 1e-6]), 0.9, 0.01, True)
    assert worth_a_link(sure, 0.6)
    assert worth_a_link(replace(sure, covariance=np.diag([1e4, 1e-4, 1e-6])), 0.6)  # across a smooth drift
    assert not worth_a_link(replace(sure, covariance=np.diag([1e4, 1e4, 1e-6])), 0.6)
    assert not worth_a_link(replace(sure, inliers=0.5), 0.6)
    assert not worth_a_link(replace(sure, converged=False), 0.6)


def test_many_drives_through_one_place_lie_over_each_other(driven: list[DrivenRun], truth: list[np.ndarray]) -> None:
    """The first move with each other; those after them are fitted to what is there, and all move in the end."""
    path, true = whole_run(driven[0]), truth[0][driven[0].loop.keyframes]
    count = 60  # key frames: before the run meets its own beginning
    first = beginning(path, count)
    rng, copies = np.random.default_rng(2), FIRST_DRIVES + 4
    starts = [np.zeros(3), *rng.normal(0, [0.3, 0.1, 0.02], (copies - 1, 3))]
    bent = [turn_aside(first, 20 + k, 0.01 * (-1) ** k) for k in range(copies)]
    piece = map_piece([replace(of, start=at) for of, at in zip(bent, starts, strict=True)], match_scans)
    assert off(piece.poses, np.tile(true[:count], (copies, 1))).max() < 0.1


def test_later_drives_are_stiff_where_they_are_alone(driven: list[DrivenRun]) -> None:
    """The third drive over the same ground goes on where the first two ended."""
    path = whole_run(driven[0])
    drives = [beginning(path, count) for count in (40, 40, 60)]
    piece = map_piece(drives, match_scans)
    ends = piece.links.ends[piece.strong]
    for first, last in ((0, 40), (40, 80)):
        assert np.sum(np.all((ends >= first) & (ends < last), axis=1)) > 60
    third = ends[np.all(ends >= 80, axis=1)] - 80
    assert np.sum(third.max(axis=1) < 36) == 0
    assert np.sum(third.max(axis=1) > 44) > 20


def test_held_poses_stay_and_waiting_ones_wait() -> None:
    """Links say 1 m from pose to pose; the third is not there yet, the second is held 0.2 m too far."""
    poses = np.array([[0.0, 0, 0], [1.2, 0, 0], [9, 9, 0], [5, 1, 0.3]])
    step = np.array([[1.0, 0, 0]] * 3)
    links = Links.of(np.array([[0, 1], [1, 2], [1, 3]]), step, np.tile(np.eye(3), (3, 1, 1)), robust=False)
    here, held = np.array([True, True, False, True]), np.array([False, True, False, False])
    assert_allclose(
        solve_present(poses, links, here, held), [[0, 0, 0], [1.2, 0, 0], [9, 9, 0], [2.2, 0, 0]], atol=1e-9
    )
    free = solve_present(poses, links, here, np.zeros(4, bool))
    assert_allclose(free, [[0, 0, 0], [1, 0, 0], [9, 9, 0], [2, 0, 0]], atol=1e-9)
