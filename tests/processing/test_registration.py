"""Passes of one tag registered by their scans; paths that share their tags, and those that share their drift."""

from dataclasses import replace

import numpy as np
import pytest

from processing.geometry import accumulate, compose, relative, wrap_angle
from processing.graph import build_graph
from processing.open_loop import mount_pose
from processing.pieces import split_drifts
from processing.pipeline import DrivenRun, piece_input
from processing.registration import (
    Passing,
    find_near,
    lies_along,
    likely_headings,
    pass_hypotheses,
    path_starts,
    register_passes,
)
from processing.scan_walls import Scan, prepare_scan

STRAIGHT = np.column_stack([np.arange(0, 80, 0.75), np.zeros(107), np.zeros(107)])


def scan_of(of: DrivenRun, k: int) -> Scan:
    return of.loop.sweeps.scan(k)


def lone(scan: Scan) -> Passing:
    """A pass of which nothing but its own scan is known."""
    return Passing(np.zeros((1, 3)), [scan], scan.mount, 0)


def bow(height_m: float) -> np.ndarray:
    """A path between the ends of the straight one."""
    x = STRAIGHT[:, 0]
    y = height_m * np.sin(np.pi * x / x[-1])
    return np.column_stack([x, y, np.arctan2(np.gradient(y), np.gradient(x))])


def drifting(poses: np.ndarray, share: float) -> np.ndarray:
    """The same drive, its heading lost by and by: by the end it is a share of its length off."""
    motions = relative(poses[:-1], poses[1:])
    motions[:, 2] += 2 * share / len(motions)
    return accumulate(poses[0], motions)


def backwards(poses: np.ndarray) -> np.ndarray:
    """Driven the other way, as seen in the same frame."""
    turned = poses[::-1].copy()
    turned[:, 2] = wrap_angle(turned[:, 2] + np.pi)
    return turned


def assert_near(motion: np.ndarray, true: np.ndarray, metres: float, degrees: float) -> None:
    assert np.hypot(*(motion - true)[:2]) < metres
    assert abs(wrap_angle(motion[2] - true[2])) < np.radians(degrees)


@pytest.mark.parametrize("offset_m", [-1.5, 0.0, 1.5])
def test_passes_of_a_tag_are_found_from_a_metre_and_a_half_off(
    driven: list[DrivenRun], truth: list[np.ndarray], offset_m: float
) -> None:
    """Every two passes of one tag, in the same or the opposite direction, one of them read too late or too early."""
    ways, tried = [], 0
    way = [np.append(0.0, np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T))) for poses in truth]
    passes = [(run, found) for run, of in enumerate(driven) for found in of.passes]
    for n, (run_a, a) in enumerate(passes):
        for run_b, b in passes[n + 1 :]:
            if a.epc != b.epc:
                continue
            i, j = a.centre, int(np.searchsorted(way[run_b], way[run_b][b.centre] + offset_m))
            true = relative(truth[run_a][i], truth[run_b][j])
            if np.hypot(*true[:2]) > 2.0:
                continue
            found = pass_hypotheses(lone(scan_of(driven[run_a], i)), lone(scan_of(driven[run_b], j)))
            assert_near(found[0][1].motion, true, 0.03, 0.6)
            ways.append(bool(abs(true[2]) > np.pi / 2))
            tried += 1
    assert tried >= 4
    assert set(ways) == {True, False}


def test_scans_of_different_places_are_hardly_ever_taken_for_one(
    driven: list[DrivenRun], truth: list[np.ndarray]
) -> None:
    """Drifts look alike to a scanner that sees 4 m of wall on either side: one in ten may pass."""
    of, rng = driven[0], np.random.default_rng(1)
    pairs = rng.integers(0, len(truth[0]), (40, 2))
    apart = pairs[np.hypot(*(truth[0][pairs[:, 0], :2] - truth[0][pairs[:, 1], :2]).T) > 6]
    found = [register_passes(lone(scan_of(of, i)), lone(scan_of(of, j))) for i, j in apart]
    assert len(found) > 20
    assert sum(match is not None for match in found) <= len(found) // 10


def test_a_scanner_that_saw_nothing_tells_nothing(driven: list[DrivenRun]) -> None:
    scan = scan_of(driven[0], 100)
    blind = prepare_scan(np.full_like(scan.points, np.nan), scan.angle_min, scan.angle_increment)
    for a, b in ((scan, blind), (blind, scan)):
        assert pass_hypotheses(lone(a), lone(b)) == []
        assert register_passes(lone(a), lone(b)) is None


@pytest.mark.parametrize("share", [-0.02, 0.0, 0.02])
def test_a_path_in_the_same_drift_lies_along(share: float) -> None:
    beside = STRAIGHT + np.array([0.0, 1.5, 0.0])
    for other in (STRAIGHT, beside, backwards(STRAIGHT), backwards(beside), bow(1.5)):
        assert lies_along(STRAIGHT, drifting(other, share))


def test_a_path_in_another_drift_does_not() -> None:
    for height in (8.0, 12.0, -20.0):
        assert not lies_along(STRAIGHT, bow(height))
        assert not lies_along(bow(height), STRAIGHT)
    turned = compose(np.array([0.0, 0.0, 0.5]), STRAIGHT)  # from the same tag, another way
    assert not lies_along(STRAIGHT, turned)


def test_paths_both_ways_through_an_edge_start_where_they_did(driven: list[DrivenRun], truth: list[np.ndarray]) -> None:
    """Each path of an edge in the frame of its first, open loop: what map_piece begins with."""
    graph = build_graph([of.passes for of in driven], [len(of.loop) for of in driven])
    shared = [piece for piece in graph.pieces if piece.j is not None and len(piece.spans) > 1]
    assert any(a.start == b.end for piece in shared for a in piece.spans[:1] for b in piece.spans[1:])
    for piece in shared:
        (given,) = split_drifts(piece_input("edge", piece, driven))
        first = truth[piece.spans[0].run][piece.spans[0].first]
        for span, path in zip(piece.spans, given.paths, strict=True):
            assert_near(path.start, relative(first, truth[span.run][span.first]), 0.25, 2.0)


def test_two_drifts_between_the_same_tags_become_two_pieces(driven: list[DrivenRun]) -> None:
    """With only two of its tags read, the ring is two drifts from the one to the other: east and west."""
    tags = sorted({found.epc for found in driven[0].passes})
    seen = [[found for found in of.passes if found.epc in (tags[0], tags[2])] for of in driven]
    graph = build_graph(seen, [len(of.loop) for of in driven])
    (edge,) = [piece for piece in graph.pieces if piece.j is not None]
    assert len(edge.spans) >= 2
    east, west = split_drifts(piece_input("0-1", edge, driven))
    assert (east.name, west.name) == ("0-1", "0-1b")
    assert len(east.paths) == len(east.piece.spans) == len(east.sights)
    assert len(east.paths) + len(west.paths) == len(edge.spans)
    assert set(east.piece.spans).isdisjoint(west.piece.spans)
    for part in (east, west):
        assert np.all(part.paths[0].start == 0)


def test_a_stray_path_without_a_common_tag_is_a_group_of_its_own(driven: list[DrivenRun]) -> None:
    loop = driven[0].loop
    chain, scans = loop.links[np.arange(20)], loop.scans[:21]
    starts, groups, _ = path_starts(
        [chain] * 3, [scans] * 3, [(0, 1), (2, 3), (0, 1)], [(0.0, 0.0)] * 3, [mount_pose(driven[0].run)] * 3
    )
    assert groups == [0, 1, 0]
    assert np.all(starts[0] == 0)
    assert np.all(starts[1] == 0)
    assert_near(starts[2], np.zeros(3), 0.01, 0.1)


@pytest.mark.parametrize(
    ("by_tags_deg", "doubt_deg", "expected_deg"),
    [
        (3.0, 5.0, [0]),  # along the drift
        (-175.0, 5.0, [180]),  # against it
        (12.0, 5.0, [0, 12]),  # the one or the other
        (90.0, 5.0, [90]),  # around a corner
        (90.0, 60.0, [90]),
        (60.0, 50.0, [0, 60]),  # tags close together tell little
        (95.0, 80.0, [0, 180, 95]),
    ],
)
def test_tags_far_apart_tell_which_way_a_drift_was_driven(
    by_tags_deg: float, doubt_deg: float, expected_deg: list[float]
) -> None:
    headings = likely_headings(np.radians(by_tags_deg), np.radians(doubt_deg))
    assert np.degrees(headings) == pytest.approx(expected_deg)


def test_where_no_scan_tells_the_tags_coincide(driven: list[DrivenRun]) -> None:
    """A path the other way, its scans all blind: the heading is the one that lays the paths together."""
    loop, mount = driven[0].loop, mount_pose(driven[0].run)
    chain, scans = loop.links[np.arange(40)], loop.scans[:41]
    there = accumulate(np.zeros(3), chain.motions)
    back = backwards(there)
    chain_back = replace(chain, motions=relative(back[:-1], back[1:]))
    blind = [prepare_scan(np.full_like(scan.points, np.nan), scan.angle_min, scan.angle_increment) for scan in scans]
    starts, groups, _ = path_starts(
        [chain, chain_back], [scans, blind], [(0, 1), (1, 0)], [(0.0, 0.0)] * 2, [mount] * 2
    )
    assert groups == [0, 0]
    assert_near(starts[1], back[0], 0.05, 1.0)


def test_tags_nearer_to_each_other_than_their_passes_jitter_tell_no_heading(driven: list[DrivenRun]) -> None:
    """Twelve metres apart and read from ten: two drives through a junction may pass both in any direction."""
    loop, mount = driven[0].loop, mount_pose(driven[0].run)
    chain, scans = loop.links[np.arange(15)], loop.scans[:16]
    blind = [prepare_scan(np.full_like(scan.points, np.nan), scan.angle_min, scan.angle_increment) for scan in scans]
    chains, ends = [chain, chain], [(0, 1), (0, 1)]
    _, groups, doubts_m = path_starts(chains, [scans, blind], ends, [(3.0, 3.0)] * 2, [mount] * 2)
    assert groups == [0, 0]
    assert doubts_m == [0.0, 3.0]  # by the tags alone
    assert path_starts(chains, [scans, blind], ends, [(10.0, 10.0)] * 2, [mount] * 2)[1] == [0, 1]
    starts, groups, doubts_m = path_starts(chains, [scans, scans], ends, [(10.0, 10.0)] * 2, [mount] * 2)
    assert groups == [0, 0]  # scans that see all directions tell
    assert doubts_m == [0.0, 0.0]
    assert_near(starts[1], np.zeros(3), 0.01, 0.1)


def test_a_smooth_drift_tells_no_pass_from_another() -> None:
    """Its walls leave the way along open, and a drift across would look the same."""
    angles = np.radians(np.arange(-135, 135.1, 0.5))
    with np.errstate(divide="ignore"):
        ranges = np.abs(2.0 / np.sin(angles)) + np.random.default_rng(1).normal(0, 0.01, len(angles))
    ranges[ranges > 15] = np.nan
    smooth = prepare_scan(
        np.column_stack([ranges * np.cos(angles), ranges * np.sin(angles)]), angles[0], np.radians(0.5)
    )
    assert pass_hypotheses(lone(smooth), lone(smooth))
    assert register_passes(lone(smooth), lone(smooth)) is None


def test_a_tag_that_is_read_from_afar_is_searched_for_further_off(
    driven: list[DrivenRun], truth: list[np.ndarray]
) -> None:
    of = driven[0]
    pairs = [(i, i + 20, relative(truth[0][i], truth[0][i + 20])) for i in range(100, 400, 25)]
    found = {2.0: 0, 8.0: 0}
    for i, k, true in pairs:
        for reach_m in found if 4.5 < np.hypot(*true[:2]) < 6.5 else ():
            one, other = (replace(lone(scan_of(of, at)), reach_m=reach_m) for at in (i, k))
            near = pass_hypotheses(one, other, (0.0,))
            found[reach_m] += bool(near) and np.hypot(*(near[0][1].motion - true)[:2]) < 0.1
    assert found[2.0] == 0
    assert found[8.0] >= 3


def test_a_match_is_found_from_a_guess_two_metres_off(driven: list[DrivenRun], truth: list[np.ndarray]) -> None:
    of = driven[0]
    found = 0
    for i in range(100, 400, 50):
        true = relative(truth[0][i], truth[0][i + 5])
        seen = find_near(scan_of(of, i), scan_of(of, i + 5), true + np.array([1.6, -0.5, 0.1]))
        found += seen is not None and np.hypot(*(seen.motion - true)[:2]) < 0.05
    assert found >= 5
