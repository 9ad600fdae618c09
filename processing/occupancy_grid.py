"""Occupancy grids: what the laser says of each cell of the plane, and grids of many drifts stitched into one.

In: poses of the laser with its scans; or grids with their places. Out: a `Grid` of log-odds, 0 where nothing is known.
Law: a scan says one thing of a cell: occupied if any of its beams ends there, else free if any passes. So a wall that
one beam grazes is not erased by the beams beside it. Source: Moravec & Elfes 1985; log-odds after Thrun, Burgard & Fox
2005, table 9.2; the stitching is appendix A of Lavigne & Marshall 2012, read backwards: from the cells of the whole to
those of the part, so that no turn leaves holes.

         origin + resolution (W, H)
    +-----------+           row = y, column = x; origin is a whole number of cells away from the frame's
    |           |  H        own, so that grids of one frame share their cells
    +-----------+
    origin    W

Limit: a grid is dense; memory follows its bounding box, 8 bytes a cell while it is built. Many grids wait in files.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numba
import numpy as np
from numpy.typing import NDArray

from processing.geometry import Array, inverse, transform

STEP = np.float32(0.05)  # log-odds are whole numbers of it, so that one fits into a byte
HIT = 17  # steps: p = 0.7, of a cell that a beam ends in
MISS = -8  # p = 0.4, of a cell that beams only pass
LOWEST, HIGHEST = -40, 70  # p = 0.12 … 0.97: beyond, a changed drift would never show
BITS = np.int64(24)  # behind the point


@dataclass(frozen=True, slots=True)
class Window:
    """Where in the plane the cells of a grid lie."""

    shape: tuple[int, int]  # (H, W)
    resolution_m: float
    origin: Array  # (2,) x, y of the lower-left corner of cell [0, 0]

    def rows(self, which: slice) -> "Window":
        first, last, _ = which.indices(self.shape[0])
        origin = self.origin + self.resolution_m * np.array([0, first])
        return Window((last - first, self.shape[1]), self.resolution_m, origin)


@dataclass(frozen=True, slots=True)
class Grid:
    log_odds: NDArray[np.float32]  # (H, W)
    resolution_m: float
    origin: Array  # (2,) as of its window

    @property
    def window(self) -> Window:
        return Window(self.log_odds.shape, self.resolution_m, self.origin)

    def cells(self) -> tuple[NDArray[np.float32], np.float32]:
        """The cells, and what one of them is a multiple of."""
        return self.log_odds, np.float32(1)


@dataclass(frozen=True, slots=True)
class StoredGrid:
    """A grid of whole steps in a file; of its cells, only what is looked at is read."""

    path: Path
    window: Window

    def cells(self) -> tuple[NDArray[np.int8], np.float32]:
        return np.load(self.path, mmap_mode="c"), STEP


def store_grid(grid: Grid, path: Path) -> StoredGrid:
    """Of a grid as `build_grid` makes it. Raises: OSError: the disk is full."""
    np.save(path, np.rint(grid.log_odds / STEP).astype(np.int8))
    return StoredGrid(path, grid.window)


def build_grid(
    laser_poses: Array,  # (n, 3)
    ranges: NDArray[np.floating],  # (n, B): inf no return, NaN invalid
    angles: Array,  # (B,) or (n, B), counter-clockwise in the laser's frame
    resolution_m: float = 0.05,
    max_range_m: float = 20.0,
    no_return_m: float = 5.0,
) -> Grid:
    """The grid of these scans in the frame of the poses.

    A beam frees the cells up to one cell before its end. A return beyond `max_range_m` frees that far and hits nothing;
    a beam without return frees `no_return_m` only, for black and wet rock returns nothing either.
    """
    ranges = np.atleast_2d(ranges)
    bearings = np.broadcast_to(angles, ranges.shape) + laser_poses[:, 2:3]
    reach = np.where(np.isinf(ranges), no_return_m, np.minimum(ranges, max_range_m))
    reach = np.where(reach > 0, reach, 0.0)  # NaN and negative: nothing
    ends = laser_poses[:, :2, None] + np.stack([reach * np.cos(bearings), reach * np.sin(bearings)], axis=1)
    if not ends.size:
        return Grid(np.zeros((0, 0), dtype=np.float32), resolution_m, np.zeros(2))
    ends, starts = ends / resolution_m, laser_poses[:, :2] / resolution_m
    low = np.floor(np.minimum(ends.min(axis=(0, 2)), starts.min(axis=0)))
    width, height = (np.floor(np.maximum(ends.max(axis=(0, 2)), starts.max(axis=0))) - low).astype(int) + 1
    state = np.full((height, width), -LOWEST, dtype=np.int32)
    _trace(state, starts - low, ends - low[:, None], reach > 0, (ranges > 0) & (ranges <= max_range_m))
    log_odds = ((state & 255) + LOWEST).astype(np.float32) * STEP
    return Grid(log_odds, resolution_m, low * resolution_m)


@numba.njit(cache=True)
def _trace(
    state: NDArray[np.int32],  # (H, W), in place: the steps of a cell above LOWEST + 256 · the last scan that spoke of it
    starts: Array,  # (n, 2) of the laser, in cells
    ends: Array,  # (n, 2, B) of the beams, in cells
    valid: NDArray[np.bool_],  # (n, B)
    hit: NDArray[np.bool_],  # (n, B) the beam ends on something
) -> None:
    # flat unsigned indices, and the paces in fixed point: a third faster than two signed ones of floats
    cells, columns, beams = state.reshape(-1), np.int64(state.shape[1]), ends.shape[2]
    one = np.int64(1) << BITS
    paces = np.zeros((beams, 2), np.int64)  # one cell at a time along the longer side
    counts = np.zeros(beams, np.int64)  # of them
    for scan in range(len(starts)):
        x0, y0 = starts[scan]
        spoken = np.int32((scan + 1) << 8)
        for beam in range(beams):
            dx, dy = ends[scan, 0, beam] - x0, ends[scan, 1, beam] - y0
            length = max(abs(dx), abs(dy))
            counts[beam] = np.int64(length) if valid[scan, beam] else 0
            if counts[beam] > 0:
                paces[beam, 0], paces[beam, 1] = np.int64(dx / length * one), np.int64(dy / length * one)
            if hit[scan, beam]:
                cell = np.uint64(np.int64(ends[scan, 1, beam]) * columns + np.int64(ends[scan, 0, beam]))
                if cells[cell] < spoken:
                    cells[cell] = spoken | min((cells[cell] & 255) + HIT, HIGHEST - LOWEST)
        for beam in range(beams):
            if counts[beam] == 0:
                continue
            first = _passed(paces, counts, beam)
            pace_x, pace_y = paces[beam]
            x, y = np.int64(x0 * one) + first * pace_x, np.int64(y0 * one) + first * pace_y
            for _ in range(first, counts[beam]):
                cell = np.uint64((y >> BITS) * columns + (x >> BITS))
                if cells[cell] < spoken:
                    cells[cell] = spoken | max((cells[cell] & 255) + MISS, 0)
                x += pace_x
                y += pace_y


@numba.njit(cache=True)
def _passed(paces: NDArray[np.int64], counts: NDArray[np.int64], beam: int) -> int:
    """How many of the first cells of a beam others pass for it: near the laser, beams lie closer than cells.

    Of two beams to both sides, less than a cell apart, one passes the cell between; beam 4 k + 2 has its neighbours
    among those that can be divided by 4, and so on.
    """
    stride = beam & -beam
    a, b = beam - stride, beam + stride
    if stride == 0 or b >= len(counts) or counts[a] == 0 or counts[b] == 0:
        return 0
    one = np.int64(1) << BITS
    for along in range(2):
        if abs(paces[beam, along]) == one and paces[a, along] == paces[beam, along] == paces[b, along]:
            apart = abs(paces[a, 1 - along] - paces[b, 1 - along])
            return min(counts[a], counts[b], counts[beam], one // max(apart, 1))
    return 0


def stitched_window(grids: Sequence[Grid | StoredGrid], placements: Array) -> Window:
    """What the grids cover together. Raises: ValueError: there is no grid, or their resolutions differ."""
    if not grids or len(grids) != len(placements) or len({grid.window.resolution_m for grid in grids}) != 1:
        raise ValueError(f"{len(grids)} grids and {len(placements)} placements do not make one map of one resolution")
    resolution_m = grids[0].window.resolution_m
    corners = np.concatenate([_corners(grid.window, pose) for grid, pose in zip(grids, placements, strict=True)])
    low = np.floor(corners.min(axis=0) / resolution_m + 1e-6)
    width, height = (np.ceil(corners.max(axis=0) / resolution_m - 1e-6) - low).astype(int).tolist()
    return Window((height, width), resolution_m, low * resolution_m)


def stitch(grids: Sequence[Grid | StoredGrid], placements: Array, window: Window | None = None) -> Grid:
    """One grid of many: each placed by its pose in `placements` (k, 3), log-odds added, values in between interpolated.

    Of the whole, or of a window of it.

    Raises:
        ValueError: there is no grid, or their resolutions differ.
    """
    window = stitched_window(grids, placements) if window is None else window
    whole = Grid(np.zeros(window.shape, dtype=np.float32), window.resolution_m, window.origin)
    for grid, pose in zip(grids, placements, strict=True):
        add_grid(whole, grid, pose)
    return whole


def add_grid(whole: Grid, part: Grid | StoredGrid, pose: Array) -> None:
    """Add the log-odds of `part`, placed at `pose` (3,), to those cells of `whole` that it covers, in place.

    `whole` may be any window of the plane: a map too large for the memory is made window by window.
    """
    resolution_m = whole.resolution_m
    corners = (_corners(part.window, pose) - whole.origin) / resolution_m
    first = np.maximum(np.floor(corners.min(axis=0)), 0).astype(int)
    last = np.minimum(np.ceil(corners.max(axis=0)), whole.log_odds.shape[::-1]).astype(int)
    if np.any(first >= last):
        return
    # the centre of cell [0, 0] of the whole, and the pose's turn, seen from the part in its cells
    back = inverse(pose)
    start = (transform(back, whole.origin + resolution_m / 2) - part.window.origin) / resolution_m - 0.5
    turn = np.array([np.cos(back[2]), np.sin(back[2])])
    cells, unit = part.cells()
    _resample(whole.log_odds, cells, unit, start, turn, first, last)


@numba.njit(cache=True)
def _resample(
    whole: NDArray[np.float32],  # (H, W), changed in place
    part: NDArray[np.float32] | NDArray[np.int8],  # (h, w)
    unit: np.float32,  # of which the part is a multiple
    start: Array,  # (2,) centre of whole[0, 0], counted in cells from the centre of part[0, 0]
    turn: Array,  # (2,) cosine, sine: one column further in the whole
    first: NDArray[np.int64],  # (2,) column, row of the whole
    last: NDArray[np.int64],  # (2,) one beyond
) -> None:
    height, width = part.shape
    for row in range(first[1], last[1]):
        low, high = first[0], last[0]
        for at, step, size in (
            (start[0] - turn[1] * row, turn[0], width),
            (start[1] + turn[0] * row, turn[1], height),
        ):
            if abs(step) > 1e-9:  # where this row enters the part, and where it leaves it
                enter, leave = (-1.0 - at) / step, (size - at) / step
                low = max(low, math.floor(min(enter, leave)))
                high = min(high, math.ceil(max(enter, leave)) + 1)
        for column in range(low, high):
            x = start[0] + turn[0] * column - turn[1] * row
            y = start[1] + turn[1] * column + turn[0] * row
            left, below = int(np.floor(x + 1e-6)), int(np.floor(y + 1e-6))
            if left < -1 or below < -1 or left >= width or below >= height:
                continue
            u, v = x - left, y - below
            if u < 1e-6:
                u = 0.0
            if v < 1e-6:
                v = 0.0
            if (
                0 <= left < width - 1
                and 0 <= below < height - 1
                and part[below, left] == part[below, left + 1] == 0
                and part[below + 1, left] == part[below + 1, left + 1] == 0
            ):
                continue
            value = 0.0
            for i, weight_y in ((below, 1.0 - v), (below + 1, v)):
                for j, weight_x in ((left, 1.0 - u), (left + 1, u)):
                    if 0 <= i < height and 0 <= j < width:
                        value += weight_x * weight_y * part[i, j]
            whole[row, column] += np.float32(value * unit)


def _corners(window: Window, pose: Array) -> Array:
    """The four corners (4, 2) of the placed window."""
    height, width = window.shape
    unit = np.array([[0, 0], [width, 0], [width, height], [0, height]])
    return transform(pose, window.origin + window.resolution_m * unit)
