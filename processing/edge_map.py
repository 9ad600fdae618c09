"""Closed-loop poses of one piece of the map: an edge between two beacons, a spur, or a whole run without tags.

In: paths, each the key frames of one drive through the piece, open loop from its own (0, 0, 0): the weak links. Out:
poses of all key frames in one frame, with strong links found between them, iterated until links and poses settle
(paper, section 2.3 and figure 6; Lu & Milios 1997).

The piece grows along the drives: a stretch at a time is added, linked to what is already there, and solved, so that the
guess for the next links is never worse than one stretch of open loop.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from processing.geometry import accumulate, relative
from processing.known_matches import Matches, match_loops
from processing.pose_graph import CORNER, NO_LINKS, Links, Solution, solve
from processing.relocation import relocate_stretch
from processing.scan_matching import Matcher
from processing.strong_links import (
    FIRST_DRIVES,
    HOP_INLIERS,
    LOOP_RADIUS_M,
    KeyFrames,
    hop_pairs,
    loop_pairs,
    match_pairs,
)
from processing.sweeps import StoredScans

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

STRETCH_M = 5.0
FEW, LEAST_SHARE = 3, 0.3  # so many pairs or more, of which less than this share match, are no closed loop
LOST_M, LOST_RAD = 5.0, 0.6  # how far to look for a stretch that is not where it should be
GRADUAL = (1e7, 1e6, 1e5, 1e4, 1e3, 1e2, CORNER)
STIFF_DRIVES = 2  # later ones must be stiff themselves only where they are alone
MAX_ROUNDS = 5
MAX_DRIFT_M, MAX_DRIFT_RAD = 7.0, 0.6  # beyond, a search finds more wrong places than right ones
WEAK_M, WEAK_RAD = 0.2, 0.05  # a link of the chain with more doubt than this
TAG_M, TAG_RAD = 3.0, 0.5  # how well a tag alone joins two paths
DOUBTED = 0.1  # a strong link of less weight is dropped, and may be found again from better poses


@dataclass(frozen=True, slots=True)
class Path:
    """One drive through the piece: K key frames."""

    run_id: str
    keyframes: Ints  # (K,) their numbers in the run
    scans: StoredScans  # K
    chain: Links  # K - 1 weak links, between (0, 1), (1, 2) …
    wheels: Links  # K - 1, odometry alone
    start: Array  # (3,) first guess of the first pose in the frame of the piece
    start_doubt_m: float = 0.0  # how far off that may be


@dataclass(frozen=True, slots=True)
class PieceMap:
    poses: Array  # (N, 3) of all paths' key frames, one path after the other
    firsts: Ints  # (P + 1,) where each path begins; the last is N
    links: Links  # weak and strong
    solution: Solution

    def path(self, p: int) -> slice:
        return slice(int(self.firsts[p]), int(self.firsts[p + 1]))

    @property
    def in_a_row(self) -> NDArray[np.bool_]:
        """(m,) links between neighbours on a path: the chain of the drive and its odometry."""
        ends = self.links.ends
        path = np.searchsorted(self.firsts, ends, side="right")
        return np.asarray((path[:, 0] == path[:, 1]) & (np.abs(ends[:, 1] - ends[:, 0]) == 1))

    @property
    def strong(self) -> NDArray[np.bool_]:
        """(m,) links that are scan matches of poses which are no neighbours. The others are in a row, or what a tag
        alone joins.
        """
        return np.asarray(self.links.robust & ~self.in_a_row)


@dataclass(frozen=True, slots=True)
class Drift:
    """How far a drive may have strayed since it was last linked to what was there before: three standard deviations."""

    variance_m2: float = 0.0  # of the links' own position
    variance_rad2: float = 0.0
    sway_m: float = 0.0  # what the heading's error makes of the way: it adds up as metres, not as variances
    way_m: float = 0.0

    @staticmethod
    def of(radius_m: float, radius_rad: float) -> "Drift":
        return Drift((radius_m / 3) ** 2, (radius_rad / 3) ** 2)

    def after(self, chain: Links) -> "Drift":
        covariances = np.linalg.inv(chain.informations)
        turn = self.variance_rad2 + np.cumsum(covariances[:, 2, 2])
        steps = np.hypot(*chain.motions[:, :2].T)
        moved = covariances[:, 0, 0].sum() + covariances[:, 1, 1].sum()
        return Drift(
            self.variance_m2 + float(moved),
            float(turn[-1]),
            self.sway_m + float(steps @ np.sqrt(turn)),
            self.way_m + float(steps.sum()),
        )

    def at_most(self, radius_m: float, radius_rad: float) -> "Drift":
        """This drift, or a smaller one that is known from elsewhere."""
        return self if self.radius_m <= radius_m else Drift.of(radius_m, radius_rad)

    @property
    def is_astray(self) -> bool:
        """Too far for a match from here?"""
        return self.radius_m > 1.0 or self.radius_rad > 0.2

    @property
    def radius_m(self) -> float:
        return min(3 * float(np.hypot(self.variance_m2**0.5, self.sway_m)) + 0.02 * self.way_m, MAX_DRIFT_M)

    @property
    def radius_rad(self) -> float:
        return min(3 * self.variance_rad2**0.5 + 0.003 * self.way_m, MAX_DRIFT_RAD)


def map_piece(paths: list[Path], match: Matcher) -> PieceMap:
    """Find strong links and solve until they settle. The first pose of the first path stays where it starts."""
    frames, chain, firsts = _join(paths, match)
    poses = np.concatenate([accumulate(path.start, path.chain.motions) for path in paths])
    links = (
        chain
        + _wheels(paths, firsts)
        + _joins(paths, firsts)
        + _hops(frames, poses, hop_pairs(frames, range(min(len(paths), STIFF_DRIVES))))
    )
    loops, known = NO_LINKS, [Matches.none()]
    present = np.zeros(len(poses), bool)
    strayed = np.zeros((len(poses), 2))  # how far each key frame may have strayed: m, rad
    for path in range(len(paths)):
        drift = Drift.of(paths[path].start_doubt_m, LOST_RAD if paths[path].start_doubt_m else 0.0)
        held = frames.drive < path
        for stretch in _stretches(frames, chain, np.arange(firsts[path], firsts[path + 1])):
            if stretch[0] > firsts[path]:  # carry on from what the graph has made of the stretch before
                onward = chain[(chain.ends[:, 1] >= stretch[0]) & (chain.ends[:, 1] <= stretch[-1])]
                poses[stretch] = accumulate(poses[stretch[0] - 1], onward.motions)[1:]
                drift = drift.after(onward)
            old = np.flatnonzero(present)
            present[stretch] = True
            placed, closed, poses, lost = _close(
                frames, poses, links + loops, stretch, old, present, held, strayed, drift
            )
            if lost:
                drift = Drift.of(LOST_M, LOST_RAD)
            known.append(closed)
            found = placed + closed.links
            loops = loops + found
            if len(found):
                poses = solve_present(poses, links + loops, present, held)
                anchor = found.ends[:, 0][np.argmin(strayed[found.ends[:, 0], 0])]
                drift = drift.at_most(*strayed[anchor])  # no surer than what it is linked to
            strayed[stretch] = drift.radius_m, drift.radius_rad
        if path >= STIFF_DRIVES:
            pairs, linked = hop_pairs(frames, [path]), np.zeros(len(poses), bool)
            linked[loops.ends] = True
            links = links + _hops(frames, poses, pairs[~np.all(linked[pairs], axis=1)])
        if path < FIRST_DRIVES:  # these move with each other; of more, the last hardly tell the first anything new
            poses = solve_present(poses, links + loops, present, np.zeros(len(poses), bool))
    return _settle(frames, links, poses, firsts, Matches.joined(known))


def _hops(frames: KeyFrames, poses: Array, pairs: Ints) -> Links:
    return match_pairs(frames, poses, pairs, HOP_INLIERS, between_drives=False)


def _close(
    frames: KeyFrames,
    poses: Array,
    links: Links,
    stretch: Ints,
    old: Ints,
    present: NDArray[np.bool_],
    held: NDArray[np.bool_],
    strayed: Array,
    drift: Drift,
) -> tuple[Links, Matches, Array, bool]:
    """Where a new stretch was found, the loops that it closes, the poses with it there, and whether it is lost.

    Where most pairs that should match do not, the stretch lies elsewhere, and the few that do are chance.
    """
    for radius_m, radius_rad in ((drift.radius_m, drift.radius_rad), (LOST_M, LOST_RAD)):
        lost = radius_m > drift.radius_m
        placed, tried = NO_LINKS, poses
        if drift.is_astray or lost:
            surer = old[strayed[old, 0] < 0.5 * radius_m]
            placed = relocate_stretch(frames, poses, stretch, surer, radius_m, radius_rad)
            if lost and not len(placed):
                break
            if len(placed):
                tried = solve_present(poses, links + placed, present, held, GRADUAL)
        pairs = loop_pairs(frames, tried, stretch, old, LOOP_RADIUS_M)
        closed = match_loops(frames, tried, pairs, known=Matches.none())
        if len(closed.pairs) < FEW or len(closed.links) >= LEAST_SHARE * len(closed.pairs):
            return placed, closed, tried, False
    return NO_LINKS, Matches.none(), poses, True


def _settle(frames: KeyFrames, links: Links, poses: Array, firsts: Ints, loops: Matches) -> PieceMap:
    """Search all loops anew from the solved poses, until the set of links no longer changes."""
    everything = np.arange(len(poses))
    for _ in range(MAX_ROUNDS):
        known = {tuple(ends) for ends in loops.links.ends.tolist()}
        loops = match_loops(frames, poses, loop_pairs(frames, poses, everything, everything, LOOP_RADIUS_M), loops)
        solution = solve(poses, links + loops.links)
        poses = solution.poses
        found = {tuple(ends) for ends in loops.links.ends.tolist()}
        if len(found ^ known) <= 0.02 * len(found):
            break
    all_links = links + loops.links
    believed = all_links[np.flatnonzero(solution.weights >= DOUBTED)]
    solution = solve(poses, believed)
    return PieceMap(solution.poses, firsts, believed, solution)


def solve_present(
    poses: Array,
    links: Links,
    present: NDArray[np.bool_],
    held: NDArray[np.bool_],
    corners: tuple[float, ...] = (CORNER,),
) -> Array:
    """Solve for the key frames that are there already; the others wait, and those that are held stay where they are.

    With falling corners (graduated non-convexity), links that are far from fulfilled at first get their chance before
    they are doubted.
    """
    numbers = np.cumsum(present) - 1
    inside = np.flatnonzero(np.all(present[links.ends], axis=1) & ~np.all(held[links.ends], axis=1))
    part = links[inside]
    part = Links(numbers[part.ends], part.motions, part.informations, part.robust)
    fixed = held[present]
    fixed[0] = True
    solved = poses.copy()
    for corner in corners:
        solved[present] = solve(solved[present], part, fixed=fixed, corner=corner, max_iterations=4).poses
    return solved


def _join(paths: list[Path], match: Matcher) -> tuple[KeyFrames, Links, Ints]:
    firsts = np.cumsum([0] + [len(path.scans) for path in paths])
    chain = paths[0].chain
    for path, first in zip(paths[1:], firsts[1:], strict=False):
        chain = chain + path.chain.shifted(int(first))
    travelled = [np.append(0.0, np.cumsum(np.hypot(*path.chain.motions[:, :2].T))) for path in paths]
    scans = [scan for path in paths for scan in path.scans]
    frames = KeyFrames(
        scans=scans,
        drive=np.repeat(np.arange(len(paths)), np.diff(firsts)),
        travelled=np.concatenate(travelled),
        mounts=np.array([scan.mount for scan in scans]),
        match=match,
    )
    return frames, chain, firsts


def _stretches(frames: KeyFrames, chain: Links, members: Ints) -> list[Ints]:
    """Cut a drive every STRETCH_M, and wherever its chain is so weak that what follows may lie elsewhere."""
    bins = (frames.travelled[members] // STRETCH_M).astype(int)
    covariances = np.linalg.inv(chain.informations[np.isin(chain.ends[:, 1], members[1:])])
    weak = (covariances[:, 0, 0] + covariances[:, 1, 1] > WEAK_M**2) | (covariances[:, 2, 2] > WEAK_RAD**2)
    return np.split(members, np.flatnonzero((np.diff(bins) != 0) | weak) + 1)


def _joins(paths: list[Path], firsts: Ints) -> Links:
    """All that is known without strong links of where a path begins: what its tag says. Keeps the graph whole."""
    ends = np.column_stack([np.zeros(len(paths) - 1, np.int64), firsts[1:-1]])
    motions = [relative(paths[0].start, path.start) for path in paths[1:]]
    informations = np.tile(np.diag([TAG_M**-2, TAG_M**-2, TAG_RAD**-2]), (len(motions), 1, 1))
    return Links.of(ends, np.array(motions), informations, robust=False)


def _wheels(paths: list[Path], firsts: Ints) -> Links:
    links = paths[0].wheels
    for path, first in zip(paths[1:], firsts[1:], strict=False):
        links = links + path.wheels.shifted(int(first))
    return links
