"""Tags that a run drove by without reading: found where the first map puts the run over passes of other runs.

In: the poses of all key frames in one frame, the passes of every run. Out: for each run the passes that it should have
had, so that it can be cut there, and what it drove twice is one drift with one wall.

    others   ──i────────j────────k──
    this     ──i─────────────────k──      comes within NEAR_M of a pass of j, and the scans match: a pass without a read
"""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from processing.beacons import Pass
from processing.geometry import relative
from processing.scan_matching import Matcher
from processing.scan_walls import Scan
from processing.strong_links import LOOP_INLIERS, facing, match_vehicles, worth_a_link

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

NEAR_M = 2.5  # as near as key frames of different pieces are linked
AROUND_M = 8.0  # a drive that stays as near to a tag, and reads it once, has not missed it
END_M = 3.0  # what begins or ends nearer to a tag does not pass it


@dataclass(frozen=True, slots=True)
class MappedRun:
    """One run in the first map: K key frames."""

    passes: Sequence[Pass]
    keyframes: Ints  # (K,) scans
    poses: Array  # (K, 3) in the frame of the part
    scans: Sequence[Scan]  # K
    part: int
    mount: Array  # (3,)


def find_missed(runs: Sequence[MappedRun], match: Matcher) -> list[list[Pass]]:
    """For each run the passes without a read, in driving order."""
    missed: list[list[Pass]] = [[] for _ in runs]
    tracks = [_Track.of(run) for run in runs]
    places: dict[str, list[tuple[int, int]]] = defaultdict(list)
    for r, run in enumerate(runs):
        for found in run.passes:
            places[found.epc].append((r, int(np.searchsorted(run.keyframes, found.centre))))
    for epc, of in sorted(places.items()):
        for r, run in enumerate(runs):
            near = [(q, k) for q, k in of if runs[q].part == run.part]
            if near:
                read = [k for q, k in of if q == r]
                missed[r] += [
                    _silent_pass(epc, run, k)
                    for k, place in tracks[r].unread_visits(np.array([runs[q].poses[k, :2] for q, k in near]), read)
                    if _sees_the_same(runs[near[place][0]], near[place][1], run, k, match)
                ]
    return [sorted(of_run, key=lambda found: found.centre) for of_run in missed]


def add_passes(passes: Sequence[Pass], missed: Sequence[Pass]) -> list[Pass]:
    """All passes of a run in driving order; no two at one scan."""
    taken = {found.centre for found in passes}
    return sorted([*passes, *(found for found in missed if found.centre not in taken)], key=lambda found: found.centre)


@dataclass(frozen=True, slots=True)
class _Track:
    """Where a run drove, ready to be asked who came near: the work for a tag does not grow with the run."""

    at: Array  # (K, 2)
    way: Array  # (K,) m driven until there
    tree: cKDTree

    @staticmethod
    def of(run: MappedRun) -> "_Track":
        at = run.poses[:, :2]
        return _Track(at, np.append(0.0, np.cumsum(np.hypot(*np.diff(at, axis=0).T))), cKDTree(at))

    def unread_visits(self, places: Array, read: list[int]) -> Iterator[tuple[int, int]]:
        """The key frame nearest to a place, and that place, for every stay around the places (p, 2) without a read."""
        close = self.tree.query_ball_point(places, AROUND_M)
        around = np.array(sorted({k for of_place in close for k in of_place}), np.int64)
        apart = np.hypot(*np.moveaxis(self.at[around, None] - places, -1, 0))
        for stay in np.split(np.arange(len(around)), np.flatnonzero(np.diff(around) > 1) + 1):
            if not len(stay) or any(around[stay[0]] <= k <= around[stay[-1]] for k in read):
                continue
            nearest = int(stay[np.argmin(apart[stay].min(axis=1))])
            k = int(around[nearest])
            if apart[nearest].min() < NEAR_M and END_M < self.way[k] < self.way[-1] - END_M:
                yield k, int(np.argmin(apart[nearest]))


def _sees_the_same(reference: MappedRun, i: int, run: MappedRun, k: int, match: Matcher) -> bool:
    i, k = facing(reference.poses, i, run.poses, k, (reference.mount, run.mount))
    guess = relative(reference.poses[i], run.poses[k])
    return worth_a_link(match_vehicles(reference.scans[i], run.scans[k], guess, match), LOOP_INLIERS)


def _silent_pass(epc: str, run: MappedRun, k: int) -> Pass:
    scan, (x, y, _) = int(run.keyframes[k]), run.poses[k].tolist()
    return Pass(epc, scan, scan, scan, x, y, 0.0, read=False)
