"""Where the paths of a piece begin in its frame: passes of the same tag, registered to each other by their scans.

The centre of a read cloud jitters by a metre or more from pass to pass, and nothing in a read says which way the
vehicle was heading. Both are found by matching the two scans at the passes from starts spread around the tag, facing
both ways. Paths that cannot lie in the same drift, though they join the same tags, are told apart here.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from processing.geometry import accumulate, compose, inverse
from processing.pose_graph import Links
from processing.scan_match import ScanMatch, through_mount
from processing.scan_matching import Scan, score, search_match

Array = NDArray[np.float64]

SEARCH_M, SEARCH_RAD = 2.0, 0.3  # how far apart two passes of a tag may be
MIN_INLIERS = 0.75
SAME_DRIFT_M, SAME_DRIFT_SHARE = 3.0, 0.03  # how far a path may lie beside another in the same drift, plus drift


def register_passes(reference: Scan, current: Scan, mount: Array) -> ScanMatch | None:
    """Motion of the vehicle from one pass of a tag to another pass of it; None where the scans do not tell."""
    best: ScanMatch | None = None
    for heading in (0.0, np.pi):
        guess = compose(inverse(mount), compose(np.array([0.0, 0.0, heading]), mount))
        found = search_match(reference, current, guess, SEARCH_M, SEARCH_RAD)
        if found.converged and found.inliers >= MIN_INLIERS and (best is None or score(found) > score(best)):
            motion, covariance = through_mount(mount, found.motion, found.covariance)
            best = replace(found, motion=motion, covariance=covariance)
    return best


def path_starts(
    chains: list[Links],  # per path
    scans: list[list[Scan]],  # per path
    ends: list[tuple[int | None, int | None]],  # nodes at the first and last key frame of each path
    mount: Array,
    same_drift: bool,
) -> tuple[list[Array], list[int]]:
    """The start of each path (3,) in the frame of the first path of its group, and each path's group.

    The first path of a group starts at zero. With `same_drift`, paths of one group lie in the same drift; without,
    they only have a tag in common.
    """
    poses = [accumulate(np.zeros(3), chain.motions) for chain in chains]
    starts: list[Array] = []
    groups: list[int] = []
    for p in range(len(chains)):
        placed = None
        for leader in dict.fromkeys(groups):
            first = groups.index(leader)
            placed = _place(first, p, poses, scans, ends, mount)
            if placed is not None and (not same_drift or lies_along(poses[first], compose(placed, poses[p]))):
                groups.append(leader)
                starts.append(placed)
                break
            placed = None
        if placed is None:
            groups.append(p)
            starts.append(np.zeros(3))
    return starts, groups


def _place(
    a: int,
    b: int,
    poses: list[Array],
    scans: list[list[Scan]],
    ends: list[tuple[int | None, int | None]],
    mount: Array,
) -> Array | None:
    """Start of path `b` in the frame of path `a`, through a node that both touch."""
    guesses = []
    for end_a in (0, -1):
        for end_b in (0, -1):
            node = ends[a][end_a]
            if node is None or node != ends[b][end_b]:
                continue
            found = register_passes(scans[a][end_a], scans[b][end_b], mount)
            if found is not None:
                return compose(compose(poses[a][end_a], found.motion), inverse(poses[b][end_b]))
            guesses.append((end_a, end_b))
    if not guesses:
        return None
    # No scan tells: the tags coincide, and the heading is the one that brings the paths closest together.
    end_a, end_b = guesses[0]
    candidates = [
        compose(compose(poses[a][end_a], np.array([0.0, 0.0, heading])), inverse(poses[b][end_b]))
        for heading in (0.0, np.pi)
    ]
    tree = cKDTree(poses[a][:, :2])
    return min(candidates, key=lambda start: float(tree.query(compose(start, poses[b])[:, :2])[0].mean()))


def lies_along(reference: Array, poses: Array) -> bool:
    """Does a path run along another for most of the way, as far as open-loop drift lets one tell?"""
    travelled = np.append(0.0, np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T)))
    distance, _ = cKDTree(reference[:, :2]).query(poses[:, :2])
    from_ends = np.minimum(travelled, travelled[-1] - travelled)
    return bool(np.mean(distance > SAME_DRIFT_M + SAME_DRIFT_SHARE * from_ends) < 0.1)
