"""Where the paths of a piece begin in its frame: passes of the same tag, registered to each other by their scans.

The centre of a read cloud jitters by a metre or more from pass to pass, and nothing in a read says which way the
vehicle was heading. Both are found by matching the two scans at the passes from starts spread around the tag, facing
both ways. Paths that cannot lie in the same drift, though they join the same tags, are told apart here.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from processing.geometry import accumulate, compose, inverse
from processing.match_search import agreement, search_match
from processing.pose_graph import Links
from processing.scan_match import ScanMatch, through_mount
from processing.scan_matching import CLOSEST_M, match_scans
from processing.scan_walls import Scan

Array = NDArray[np.float64]

SEARCH_M, SEARCH_RAD = 2.0, 0.3  # how far apart two passes of a tag may be
MIN_INLIERS = 0.75
MIN_WORTH = 0.1  # by agreement: one pair of different places in twenty has as much, nineteen of twenty passes more
SEEN_M = 0.5  # standard deviation of a motion that the walls tell in every direction
CLEARLY_BETTER = 0.15  # of two headings, by their scores: a smooth drift looks the same both ways
SAME_DRIFT_M, SAME_DRIFT_SHARE = 3.0, 0.03  # how far a path may lie beside another in the same drift, plus drift


def pass_hypotheses(reference: Scan, current: Scan, mount: Array) -> list[ScanMatch]:
    """Motions of the vehicle from one pass of a tag to another, facing the same way and the other; the better first."""
    return [match for _, match in _weigh_headings(reference, current, mount)]


def register_passes(reference: Scan, current: Scan, mount: Array) -> ScanMatch | None:
    """The motion from one pass to another; None where the scans do not tell it, or not which way the vehicle faced."""
    found = _weigh_headings(reference, current, mount)
    if not found or (len(found) > 1 and found[0][0] - found[1][0] < CLEARLY_BETTER):
        return None
    return found[0][1]


def _weigh_headings(reference: Scan, current: Scan, mount: Array) -> list[tuple[float, ScanMatch]]:
    found: list[tuple[float, ScanMatch]] = []
    for heading in (0.0, np.pi):
        guess = compose(inverse(mount), compose(np.array([0.0, 0.0, heading]), mount))
        match = search_match(reference, current, guess, SEARCH_M, SEARCH_RAD)
        if match.converged and match.inliers >= MIN_INLIERS:
            motion, covariance = through_mount(mount, match.motion, match.covariance)
            # What the other scan should have seen counts as well: one step from there looks without going anywhere.
            back = match_scans(current, reference, inverse(match.motion), reach_m=CLOSEST_M, max_iterations=1)
            worth = min(agreement(match), agreement(back))
            if worth > MIN_WORTH:
                found.append((worth, replace(match, motion=motion, covariance=covariance)))
    return sorted(found, key=lambda of: of[0], reverse=True)


def path_starts(
    chains: list[Links],  # per path
    scans: list[Sequence[Scan]],  # per path
    ends: list[tuple[int | None, int | None]],  # nodes at the first and last key frame of each path
    mount: Array,
) -> tuple[list[Array], list[int]]:
    """The start of each path (3,) in the frame of the first path of its group, and each path's group.

    The first path of a group starts at zero. Paths of one group lie in the same drift.
    """
    poses = [accumulate(np.zeros(3), chain.motions) for chain in chains]
    starts: list[Array] = []
    groups: list[int] = []
    for p in range(len(chains)):
        for leader in dict.fromkeys(groups):
            candidates = _places(leader, p, poses, scans, ends, mount)
            placed = next((at for at in candidates if lies_along(poses[leader], compose(at, poses[p]))), None)
            if placed is not None:
                groups.append(leader)
                starts.append(placed)
                break
        else:
            groups.append(p)
            starts.append(np.zeros(3))
    return starts, groups


def _places(
    a: int,
    b: int,
    poses: list[Array],
    scans: list[Sequence[Scan]],
    ends: list[tuple[int | None, int | None]],
    mount: Array,
) -> list[Array]:
    """Starts of path `b` in the frame of path `a`, through a node that both touch: the likeliest first."""
    shared = [
        (end_a, end_b)
        for end_a in (0, -1)
        for end_b in (0, -1)
        if ends[a][end_a] is not None and ends[a][end_a] == ends[b][end_b]
    ]
    hypotheses = [
        (found, compose(compose(poses[a][end_a], found.motion), inverse(poses[b][end_b])))
        for end_a, end_b in shared
        for found in pass_hypotheses(scans[a][end_a], scans[b][end_b], mount)
    ]
    # An end where the scans see the motion along the drift too says more than one between smooth walls.
    hypotheses.sort(key=lambda of: bool(np.linalg.eigvalsh(of[0].covariance[:2, :2])[-1] > SEEN_M**2))
    places = [start for _, start in hypotheses]
    # Where no scan tells, the tags coincide; of both headings, the one that brings the paths closer together.
    tree = cKDTree(poses[a][:, :2])
    blind = [
        compose(compose(poses[a][end_a], np.array([0.0, 0.0, heading])), inverse(poses[b][end_b]))
        for end_a, end_b in shared
        for heading in (0.0, np.pi)
    ]
    return places + sorted(blind, key=lambda start: float(tree.query(compose(start, poses[b])[:, :2])[0].mean()))


def lies_along(reference: Array, poses: Array) -> bool:
    """Does a path run along another for most of the way, as far as open-loop drift lets one tell?"""
    travelled = np.append(0.0, np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T)))
    distance, _ = cKDTree(reference[:, :2]).query(poses[:, :2])
    from_ends = np.minimum(travelled, travelled[-1] - travelled)
    return bool(np.mean(distance > SAME_DRIFT_M + SAME_DRIFT_SHARE * from_ends) < 0.1)
