"""Tags that a run drove by without reading: found where the first map puts the run over passes of other runs.

In: the poses of all key frames in one frame, the passes of every run. Out: for each run the passes that it should have
had, so that it can be cut there, and what it drove twice is one drift with one wall.

    others   ──i────────j────────k──
    this     ──i─────────────────k──      comes within NEAR_M of a pass of j, and the scans match: a pass without a read
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from processing.beacons import Pass
from processing.geometry import relative
from processing.scan_matching import Matcher
from processing.scan_walls import Scan
from processing.strong_links import LOOP_INLIERS, match_vehicles, worth_a_link

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
    for epc in sorted({found.epc for run in runs for found in run.passes}):
        places = [
            (r, int(np.searchsorted(run.keyframes, found.centre)))
            for r, run in enumerate(runs)
            for found in run.passes
            if found.epc == epc
        ]
        for r, run in enumerate(runs):
            near = [place for place in places if runs[place[0]].part == run.part]
            if near:
                read = [k for q, k in places if q == r]
                missed[r] += [
                    _silent_pass(epc, run, k)
                    for k, place in _unread_visits(run, np.array([runs[q].poses[k] for q, k in near]), read)
                    if _sees_the_same(runs[near[place][0]], near[place][1], run, k, match)
                ]
    return [sorted(of_run, key=lambda found: found.centre) for of_run in missed]


def add_passes(passes: Sequence[Pass], missed: Sequence[Pass]) -> list[Pass]:
    """All passes of a run in driving order; no two at one scan."""
    taken = {found.centre for found in passes}
    return sorted([*passes, *(found for found in missed if found.centre not in taken)], key=lambda found: found.centre)


def _unread_visits(run: MappedRun, places: Array, read: list[int]) -> Iterator[tuple[int, int]]:
    """The key frame nearest to a place, and that place, for every stay around the places (p, 3) without a read."""
    distance, nearest = cKDTree(places[:, :2]).query(run.poses[:, :2], distance_upper_bound=AROUND_M)
    around = np.flatnonzero(np.isfinite(distance))
    way = np.append(0.0, np.cumsum(np.hypot(*np.diff(run.poses[:, :2], axis=0).T)))
    for stay in np.split(around, np.flatnonzero(np.diff(around) > 1) + 1):
        if not len(stay) or any(stay[0] <= k <= stay[-1] for k in read):
            continue
        k = int(stay[np.argmin(distance[stay])])
        if distance[k] < NEAR_M and END_M < way[k] < way[-1] - END_M:
            yield k, int(nearest[k])


def _sees_the_same(reference: MappedRun, i: int, run: MappedRun, k: int, match: Matcher) -> bool:
    guess = relative(reference.poses[i], run.poses[k])
    return worth_a_link(match_vehicles(reference.scans[i], run.scans[k], guess, run.mount, match), LOOP_INLIERS)


def _silent_pass(epc: str, run: MappedRun, k: int) -> Pass:
    scan, (x, y, _) = int(run.keyframes[k]), run.poses[k].tolist()
    return Pass(epc, scan, scan, scan, x, y, 0.0, read=False)
