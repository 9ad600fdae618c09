"""Stretches of two drives past one tag: do both see the same drift, and which way round?

In: what each saw for tens of metres before and after the tag, and how one may lie to the other. Out: how much of what
the one sees the other contradicts. Between smooth walls a scan fits both ways round and anywhere along; a bend, a
junction or a dead end further on does not, and only one way is right.

    one      ────────────●──────────┐          a wall of the one that lies where the other looked through
    other    ────────────●────────────         contradicts; what only one of them saw says nothing
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter

from processing.geometry import compose, inverse, relative, transform
from processing.occupancy_grid import View, build_grid
from processing.scan_walls import Scan

Array = NDArray[np.float64]

REACH_M = 50.0  # along the drive, before and after the tag: open loop goes astray by less than a cell or two
SPACING_M = 2.0  # between the scans that are looked at
CELL_M = 0.25
SEEN_M = 15.0  # farther returns graze
MOST_POINTS = 90  # of a scan
LEAST_POINTS = 10  # of a scan, that the other drive can judge
UNKNOWN, FREE, WALL = 0, 1, 2


@dataclass(frozen=True, slots=True)
class Stretch:
    """What a drive saw around a pass, in the frame of the pass."""

    points: Array  # (n, 2) m, on walls
    scan: NDArray[np.int64]  # (n,) by which scan each was seen
    cells: NDArray[np.uint8]  # (H, W) UNKNOWN, FREE or WALL
    origin: Array  # (2,) of cell [0, 0]


def stretch_rows(poses: Array, index: int) -> list[int]:
    """Which key frames (K, 3) of a drive are looked at around one of them."""
    way = np.append(0.0, np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T)))
    near = np.flatnonzero(np.abs(way - way[index]) < REACH_M)
    return near[np.unique(way[near] // SPACING_M, return_index=True)[1]].tolist()


def stretch_of(poses: Array, scans: Sequence[Scan], at: Array) -> Stretch:
    """The scans of key frames at `poses` (k, 3), in the frame of `at` (3,)."""
    laser = compose(relative(at, poses), np.array([scan.mount for scan in scans]))
    views, points = [], [np.zeros((0, 2))]
    for pose, scan in zip(laser, scans, strict=True):
        seen = scan.points[np.isfinite(scan.points[:, 0])]
        seen = seen[np.hypot(*seen.T) < SEEN_M]
        ranges = np.hypot(*seen.T)
        views.append(
            View(pose[None], seen[None].astype(np.float32), ranges[None].astype(np.float32), np.arctan2(*seen.T[::-1]))
        )
        points.append(transform(pose, seen[:: max(1, len(seen) // MOST_POINTS)]))
    grid = build_grid(views, CELL_M)
    log_odds = grid.log_odds
    cells = np.where(log_odds < 0, FREE, UNKNOWN).astype(np.uint8)
    cells[maximum_filter(log_odds > 0, 3)] = WALL  # drawn to a cell, and as much astray
    number = np.repeat(np.arange(len(points)), [len(of) for of in points])
    return Stretch(np.concatenate(points), number, cells, grid.origin)


def contradiction(one: Stretch, other: Stretch, motion: Array) -> float:
    """How many scans of both contradict the other drive, `other` lying at `motion` (3,) from `one`: each by the share
    of its points that lie where the other looked through, of those that lie where the other looked at all.
    """
    return _contradicting(one, transform(motion, other.points), other.scan) + _contradicting(
        other, transform(inverse(motion), one.points), one.scan
    )


def _contradicting(stretch: Stretch, points: Array, scan: NDArray[np.int64]) -> float:
    column, row = np.floor((points - stretch.origin) / CELL_M).astype(int).T
    height, width = stretch.cells.shape
    inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
    found, scan = stretch.cells[row[inside], column[inside]], scan[inside]
    fits, against = (np.bincount(scan[found == what], minlength=1 + scan.max(initial=0)) for what in (WALL, FREE))
    looked = fits + against
    return float((against / np.maximum(looked, 1))[looked >= LEAST_POINTS].sum())
