"""Where the paths of a piece begin in its frame: passes of the same tag, registered to each other by their scans.

The centre of a read cloud jitters by a metre or more from pass to pass, and nothing in a read says which way the
vehicle was heading. Both are found by matching two scans, those of the passes or of places near by from which the
scanners face each other, from starts spread around the tag and for both headings. Paths that cannot lie in the same
drift, though they join the same tags, are told apart here.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from processing.chain_step import to_laser, to_vehicle
from processing.geometry import accumulate, compose, compose_jacobians, inverse, relative, wrap_angle
from processing.match_search import agreement, search_match
from processing.pose_graph import Links
from processing.scan_match import ScanMatch
from processing.scan_matching import CLOSEST_M, match_scans
from processing.scan_walls import Scan
from processing.strong_links import extreme_variances, facing

Array = NDArray[np.float64]

SEARCH_M, SEARCH_RAD = 2.0, 0.3  # how far apart two passes of a tag may be
FAR_M, FARTHEST_M = 4.0, 8.0  # a tag that is read from further off has clouds that are cut off; no search goes further
MIN_INLIERS = 0.75
MIN_WORTH = 0.1  # by agreement: one pair of different places in twenty has as much, nineteen of twenty passes more
SURE_WORTH = 0.5  # one end of a path that is found as well says enough
SEEN_M = 0.5  # standard deviation of a motion that the walls tell in every direction
CLEARLY_BETTER = 0.15  # of two headings, by their scores: a smooth drift looks the same both ways
SAME_DRIFT_M, SAME_DRIFT_SHARE = 3.0, 0.03  # how far a path may lie beside another in the same drift, plus drift
QUARTERS = (0.0, np.pi, np.pi / 2, -np.pi / 2)


@dataclass(frozen=True, slots=True)
class Passing:
    """A pass, and the drive before and after it: K key frames."""

    poses: Array  # (K, 3) in any frame
    scans: Sequence[Scan]  # K
    mount: Array  # (3,) of their scanner in the vehicle
    index: int  # of the pass
    reach_m: float = 0.0  # how far its tag is read

    @property
    def pose(self) -> Array:
        return np.asarray(self.poses[self.index])


def is_open(match: ScanMatch) -> bool:
    """Do the walls leave some direction of the motion open?"""
    return extreme_variances(match.covariance)[1] > SEEN_M**2


def register_passes(reference: Passing, current: Passing) -> ScanMatch | None:
    """The motion from one pass to another; None where the scans do not tell all of it, or not which way the vehicle
    faced: between smooth walls a drift looks like the next.
    """
    found = pass_hypotheses(reference, current, QUARTERS)
    if not found or is_open(found[0][1]):
        return None
    worth, best = found[0]
    others = [other for other, match in found if abs(wrap_angle(match.motion[2] - best.motion[2])) > SEARCH_RAD]
    return best if not others or worth - others[0] >= CLEARLY_BETTER else None


def pass_hypotheses(
    reference: Passing, current: Passing, headings: Sequence[float] = (0.0, np.pi)
) -> list[tuple[float, ScanMatch]]:
    """Motions of the vehicle from one pass of a tag to another, one for each heading that fits, and what each is worth;
    the better first.
    """
    found = []
    reach_m = max(reference.reach_m, current.reach_m)
    radius_m = min(reach_m, FARTHEST_M) if reach_m > FAR_M else SEARCH_M
    for heading in headings:
        guess = np.array([0.0, 0.0, heading])
        there = compose(compose(compose(reference.pose, guess), inverse(current.pose)), current.poses)
        i, k = facing(reference.poses, reference.index, there, current.index, (reference.mount, current.mount))
        guess = relative(reference.poses[i], there[k])
        weighed = _search_around(reference.scans[i], current.scans[k], guess, radius_m)
        if weighed is not None:
            before, after = relative(reference.pose, reference.poses[i]), relative(current.poses[k], current.pose)
            found.append((weighed[0], _between(before, weighed[1], after)))
    return sorted(found, key=lambda of: of[0], reverse=True)


def _between(before: Array, match: ScanMatch, after: Array) -> ScanMatch:
    """A match with what was driven before it and after it, which adds no doubt over metres."""
    _, by_match = compose_jacobians(before, match.motion)
    motion = compose(before, match.motion)
    by_both, _ = compose_jacobians(motion, after)
    jacobian = by_both @ by_match
    return replace(match, motion=compose(motion, after), covariance=jacobian @ match.covariance @ jacobian.T)


def _search_around(
    reference: Scan, current: Scan, guess: Array, radius_m: float = SEARCH_M
) -> tuple[float, ScanMatch] | None:
    """The best match around a guess, of the vehicle, and its worth."""
    match = search_match(reference, current, to_laser(reference.mount, current.mount, guess), radius_m, SEARCH_RAD)
    if not (match.converged and match.inliers >= MIN_INLIERS):
        return None
    # What the other scan should have seen counts as well: one step from there looks without going anywhere.
    back = match_scans(current, reference, inverse(match.motion), reach_m=CLOSEST_M, max_iterations=1)
    worth = min(agreement(match), agreement(back))
    if worth <= MIN_WORTH:
        return None
    motion, covariance = to_vehicle(reference.mount, current.mount, match.motion, match.covariance)
    return worth, replace(match, motion=motion, covariance=covariance)


def find_near(reference: Scan, current: Scan, guess: Array) -> ScanMatch | None:
    """The motion of the vehicle from one scan to another, by a guess (3,) that is metres off; None where they do not
    tell all of it.
    """
    found = _search_around(reference, current, guess)
    return None if found is None or is_open(found[1]) else found[1]


def path_starts(
    chains: list[Links],  # per path
    scans: list[Sequence[Scan]],  # per path
    ends: list[tuple[int | None, int | None]],  # nodes at the first and last key frame of each path
    reaches_m: list[tuple[float, float]],  # how far the tags there are read
    mounts: list[Array],  # (3,) of the scanner of each path
) -> tuple[list[Array], list[int], list[float]]:
    """The start of each path (3,) in the frame of the first path of its group, each path's group, and how far off its
    start may be [m]: nothing where scans told it.

    The first path of a group starts at zero. Paths of one group lie in the same drift.
    """
    poses = [accumulate(np.zeros(3), chain.motions) for chain in chains]
    starts: list[Array] = []
    groups: list[int] = []
    doubts_m: list[float] = []
    for p in range(len(chains)):
        for leader in dict.fromkeys(groups):
            placed = _place_beside(leader, p, poses, scans, ends, reaches_m, mounts)
            if placed is not None:
                groups.append(leader)
                starts.append(placed[0])
                doubts_m.append(placed[1])
                break
        else:
            groups.append(p)
            starts.append(np.zeros(3))
            doubts_m.append(0.0)
    return starts, groups, doubts_m


def _place_beside(
    a: int,
    b: int,
    poses: list[Array],
    scans: list[Sequence[Scan]],
    ends: list[tuple[int | None, int | None]],
    reaches_m: list[tuple[float, float]],
    mounts: list[Array],
) -> tuple[Array, float] | None:
    """The start of path `b` in the frame of path `a`, by the nodes that both touch, and how far off it may be [m].

    None: they lie in different drifts, or nothing tells how they lie to each other.
    """
    shared = [
        (end_a, end_b)
        for end_a in (0, -1)
        for end_b in (0, -1)
        if ends[a][end_a] is not None and ends[a][end_a] == ends[b][end_b]
    ]
    jitter_m = [max(SAME_DRIFT_M, reaches_m[a][of]) for of, _ in shared]
    by_tags = _turn_by_tags(poses[a][[of for of, _ in shared]], poses[b][[of for _, of in shared]], sum(jitter_m))
    drift_m = SAME_DRIFT_SHARE * float(np.hypot(*np.diff(poses[b][:, :2], axis=0).T).sum())

    def fits(start: Array) -> bool:
        there = compose(start, poses[b])
        apart_m = [float(np.hypot(*(there[to] - poses[a][of])[:2])) for of, to in shared]
        meet = all(apart < most + drift_m for apart, most in zip(apart_m, jitter_m, strict=True))
        return meet and lies_along(poses[a], there)

    places: list[tuple[bool, float, Array]] = []
    for end_a, end_b in shared:
        one = Passing(poses[a], scans[a], mounts[a], end_a % len(poses[a]), reaches_m[a][end_a])
        other = Passing(poses[b], scans[b], mounts[b], end_b % len(poses[b]), reaches_m[b][end_b])
        if by_tags is None:  # the tags lie together: nothing but clear scans says how the paths lie
            clear = register_passes(one, other)
            found = [(1.0, clear)] if clear is not None else []
        else:
            turn, doubt_rad = by_tags
            heading = float(wrap_angle(turn + poses[b][end_b][2] - poses[a][end_a][2]))
            found = pass_hypotheses(one, other, likely_headings(heading, doubt_rad))
        for worth, match in found:
            start = compose(compose(poses[a][end_a], match.motion), inverse(poses[b][end_b]))
            if worth > SURE_WORTH and not is_open(match) and fits(start):
                return start, 0.0
            places.append((is_open(match), -worth, start))
    # An end where the scans see the motion along the drift too says more than one between smooth walls.
    places.sort(key=lambda of: of[:2])
    if by_tags is not None:  # where no scan tells, the tags coincide
        at = np.array([0.0, 0.0, by_tags[0]])
        places += [(True, 0.0, _shifted(at, poses[a][of], compose(at, poses[b][to]))) for of, to in shared]
    for blind, _, start in places:
        if fits(start):
            return start, max(jitter_m) if blind else 0.0
    return None


def _turn_by_tags(one: Array, other: Array, jitter_m: float) -> tuple[float, float] | None:
    """By how much the second path's frame is turned in the first's, from where each passes (k, 3) the same tags, and
    how far that may be off [rad]; None where these lie no further apart than passes of one tag may.
    """
    if len(one) < 2:
        return None
    chords = np.array([one[-1, :2] - one[0, :2], other[-1, :2] - other[0, :2]])
    shorter_m = float(np.hypot(*chords.T).min())
    if shorter_m < jitter_m:
        return None
    turn = float(wrap_angle(np.subtract(*np.arctan2(chords[:, 1], chords[:, 0]))))
    return turn, float(np.arcsin(jitter_m / shorter_m))


def likely_headings(by_tags_rad: float, doubt_rad: float) -> list[float]:
    """Which ways a vehicle may have passed a tag, as seen from a pass before: along the drift, this way or that, and
    as the tags say, where that is another.
    """
    off = {along: abs(float(wrap_angle(by_tags_rad - along))) for along in (0.0, np.pi)}
    headings = [along for along, rad in off.items() if rad < doubt_rad + SEARCH_RAD]
    return headings if min(off.values()) < SEARCH_RAD / 2 else [*headings, by_tags_rad]


def _shifted(start: Array, reference: Array, pose: Array) -> Array:
    """The start moved, unturned, so that `pose` comes to lie on the reference."""
    return start + np.array([*(reference - pose)[:2], 0.0])


def lies_along(reference: Array, poses: Array) -> bool:
    """Does a path run along another for most of the way, as far as open-loop drift lets one tell?"""
    travelled = np.append(0.0, np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T)))
    distance, _ = cKDTree(reference[:, :2]).query(poses[:, :2])
    from_ends = np.minimum(travelled, travelled[-1] - travelled)
    return bool(np.mean(distance > SAME_DRIFT_M + SAME_DRIFT_SHARE * from_ends) < 0.1)
