"""Beacons: the places on a trajectory where an RFID tag was passed (paper, section 2.2 and figure 5).

Driving by a tag, the vehicle reads it at many poses: the tag's *read cloud*. A pass is one drive past a tag; a later
pass of the same tag is another cloud. The tag itself is never located: it only says "here".

    pose index   40 41 42 43 44 45 46 47 48        the cloud is 41 42 44 45 47
    tag read         x  x     x  x     x           its centre is 44, the median of the index range 41 … 47
                     |<--- 2 range --->|

In: reads of (pose index, EPC), open-loop poses. Out: passes in driving order, each with a centre of its own.
"""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

MAX_GAP_POSES = 15  # a silence of 1.5 s at 0.1 s a tick, and
MAX_GAP_M = 4.0  # of so many metres: a vehicle that stands still under a tag that answers now and then makes one pass
THIN = 0.5  # of what its other clouds are long: a cloud that is read over less way is from elsewhere
THINNEST = 0.2  # of what the clouds of all tags are long


@dataclass(frozen=True, slots=True)
class Pass:
    epc: str
    centre: int  # index of the pose in the middle of the read cloud
    first: int  # indices of the first and the last read
    last: int
    x: float  # of the centre [m], in the frame of the poses
    y: float
    range_m: float  # how far from the centre the tag was still read; half a chord, so short where the drive turned
    read: bool = True  # False: the vehicle drove by and read nothing, as the map shows
    read_m: float = 0.0  # way driven while it was read: the same at any speed, and nothing where the vehicle stood


def find_passes(
    epcs: NDArray[np.str_],  # (k,)
    indices: Ints,  # (k,) pose at each read
    poses: Array,  # (n, 3)
    max_gap_poses: int = MAX_GAP_POSES,
    max_gap_m: float = MAX_GAP_M,
) -> list[Pass]:
    """Cut each tag's reads into clouds wherever it was silent for too long, and reduce each to its centre and range."""
    travelled = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T))])
    steps_m = np.gradient(travelled) if len(travelled) > 1 else np.zeros(1)
    clouds = []
    for epc in np.unique(epcs).tolist():
        reads = np.sort(indices[epcs == epc])
        silent = (np.diff(reads) > max_gap_poses) & (np.diff(travelled[reads]) > max_gap_m)
        for cloud in np.split(reads, np.flatnonzero(silent) + 1):
            first, last = int(cloud[0]), int(cloud[-1])
            clouds.append(((first + last) // 2, epc, first, last, float(steps_m[np.unique(cloud)].sum())))
    clouds.sort()
    centres = _apart(np.array([centre for centre, *_ in clouds], np.int64), len(poses))
    passes = []
    for centre, (_, epc, first, last, read_m) in zip(centres.tolist(), clouds, strict=True):
        chord = np.hypot(*(poses[last, :2] - poses[first, :2]))
        x, y = poses[centre, :2].tolist()
        passes.append(Pass(epc, centre, first, last, x, y, float(chord / 2), read_m=read_m))
    return passes


def _apart(centres: Ints, count: int) -> Ints:
    """Ascending centres, each moved by no more of the `count` poses than keeps it off its neighbours.

    Two tags on one bolt are two passes, and a drive cannot be cut twice at one pose.
    """
    rank = np.arange(len(centres))
    moved = np.maximum.accumulate(centres - rank) + rank
    return np.minimum(moved, count - len(centres) + rank)


def thin_passes(runs: Sequence[Sequence[Pass]], counts: Sequence[int]) -> list[list[Pass]]:
    """Of each run, of so many poses, the passes whose clouds are thin beside the others of their tag: a few reads from
    far down the drift, or through rock from the drift beside. A cloud that a run begins or ends in is cut off.
    """
    lengths_m: dict[str, list[float]] = defaultdict(list)
    for found in (found for passes in runs for found in passes):
        lengths_m[found.epc].append(found.read_m)
    every_m = [length_m for of in lengths_m.values() for length_m in of]
    least_m = THINNEST * float(np.median(every_m)) if every_m else 0.0  # a tag beyond the rock may have no pass at all
    usual_m = {epc: float(np.quantile(of, 0.75)) for epc, of in lengths_m.items()}

    def is_thin(found: Pass, count: int) -> bool:
        cut_off = found.first < MAX_GAP_POSES or found.last >= count - MAX_GAP_POSES
        return found.read_m < (least_m if cut_off else max(THIN * usual_m[found.epc], least_m))

    return [[of for of in passes if is_thin(of, count)] for passes, count in zip(runs, counts, strict=True)]


def overlapping_passes(passes: list[Pass]) -> list[tuple[Pass, Pass]]:
    """Passes of two different tags whose clouds overlap: both are kept, the operator should know."""
    return [(a, b) for a, b in combinations(passes, 2) if b.first <= a.last and a.first <= b.last]
