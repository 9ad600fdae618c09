"""Occupancy grids: what the laser says of each cell of the plane.

In: views: scans, and from where. Out: a `Grid` of log-odds, 0 where nothing is known. Law: a scan says one thing of a
cell: occupied if any of its beams ends there, else free if any passes. So a wall that one beam grazes is not erased by
the beams beside it. Source: Moravec & Elfes 1985; log-odds after Thrun, Burgard & Fox 2005, table 9.2.

         origin + resolution (W, H)
    +-----------+           row = y, column = x; origin is a whole number of cells away from the frame's
    |           |  H        own, so that grids of one frame share their cells
    +-----------+
    origin    W

Limit: a grid is dense; memory follows its bounding box, 4 bytes a cell while it is built, 1 after. Many wait in files.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numba
import numpy as np
from numpy.typing import NDArray

from processing.geometry import Array

ONE, STEP = np.float32(1), np.float32(0.05)  # log-odds are whole numbers of it, so that one fits into a byte
HIT = 17  # steps: p = 0.7, of a cell that a beam ends in
MISS = -8  # p = 0.4, of a cell that beams only pass
LOWEST, HIGHEST = -40, 70  # p = 0.12 … 0.97: beyond, a changed drift would never show
BITS = np.int64(24)  # behind the point
NOTHING, PASSES, HITS = 0, 1, 2  # what a beam says


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
    cells: NDArray[np.float32 | np.int8]  # (H, W)
    resolution_m: float
    origin: Array  # (2,) as of its window
    unit: np.float32 = ONE  # of log-odds, which the cells count

    @property
    def log_odds(self) -> NDArray[np.float32]:
        return self.cells * self.unit if self.unit != ONE else np.asarray(self.cells, np.float32)

    @property
    def window(self) -> Window:
        return Window(self.cells.shape, self.resolution_m, self.origin)

    def load(self) -> "Grid":
        return self


@dataclass(frozen=True, slots=True)
class StoredGrid:
    """A grid in a file; of a loaded one, only what is looked at is read."""

    path: Path
    window: Window
    unit: np.float32

    def load(self) -> Grid:
        return Grid(np.load(self.path, mmap_mode="c"), self.window.resolution_m, self.window.origin, self.unit)


def store_grid(grid: Grid, path: Path) -> StoredGrid:
    """Raises: OSError: the disk is full."""
    np.save(path, grid.cells)
    return StoredGrid(path, grid.window, grid.unit)


@dataclass(frozen=True, slots=True)
class View:
    """n scans of one scanner, and from where: B beams each."""

    laser_poses: Array  # (n, 3)
    points: NDArray[np.float32]  # (n, B, 2) where the beams ended, in the laser's frame; NaN: nowhere
    ranges: NDArray[np.float32]  # (n, B) as they were measured: inf no return, NaN invalid
    angles: Array  # (B,) of the beams, for those without return


def build_grid(
    views: Sequence[View], resolution_m: float = 0.05, max_range_m: float = 20.0, no_return_m: float = 5.0
) -> Grid:
    """The grid of these scans in the frame of the poses.

    A beam frees the cells up to one cell before its end. A return beyond `max_range_m` frees that far and hits nothing;
    a beam without return frees `no_return_m` only, for black and wet rock returns nothing either.
    """
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    limits = resolution_m, max_range_m, no_return_m
    rays = [_find_ends(view.laser_poses, view.points, view.ranges, view.angles, limits, low, high) for view in views]
    if np.any(low > high):
        return Grid(np.zeros((0, 0), dtype=np.int8), resolution_m, np.zeros(2), STEP)
    low, high = np.floor(low), np.floor(high)
    width, height = (high - low).astype(int) + 1
    state, scans = np.full((height, width), -LOWEST, np.int32), 0
    for view, (ends, kinds) in zip(views, rays, strict=True):
        _trace(state, view.laser_poses[:, :2] / resolution_m - low, ends - low, kinds, scans)
        scans += len(kinds)
    return Grid(_settle(state), resolution_m, low * resolution_m, STEP)


@numba.njit(cache=True)
def _find_ends(
    laser_poses: Array,
    points: NDArray[np.float32],
    ranges: NDArray[np.float32],
    angles: Array,
    limits: tuple[float, float, float],
    low: Array,  # (2,), in place: the lowest and
    high: Array,  # (2,) the highest cells that are touched
) -> tuple[Array, NDArray[np.int8]]:
    """Returns: where the beams end in the frame of the poses, in cells (n, B, 2); NOTHING, PASSES or HITS (n, B)."""
    resolution_m, max_range_m, no_return_m = limits
    ends, kinds = np.empty((*ranges.shape, 2)), np.empty(ranges.shape, np.int8)
    cosines, sines = np.cos(angles), np.sin(angles)
    for n in range(len(ranges)):
        x0, y0, turn = laser_poses[n]
        c, s = math.cos(turn), math.sin(turn)
        for b in range(ranges.shape[1]):
            kinds[n, b] = NOTHING
            x = y = 0.0
            if math.isinf(ranges[n, b]):
                kinds[n, b] = PASSES
                x, y = no_return_m * cosines[b], no_return_m * sines[b]
            elif ranges[n, b] > 0:
                kinds[n, b] = HITS
                x, y = np.float64(points[n, b, 0]), np.float64(points[n, b, 1])
                reach = math.sqrt(x * x + y * y)
                if reach > max_range_m:
                    kinds[n, b] = PASSES
                    x, y = x * max_range_m / reach, y * max_range_m / reach
            ends[n, b, 0] = (x0 + c * x - s * y) / resolution_m
            ends[n, b, 1] = (y0 + s * x + c * y) / resolution_m
            for k in range(2):
                low[k] = min(low[k], ends[n, b, k])
                high[k] = max(high[k], ends[n, b, k])
        for k in range(2):
            low[k] = min(low[k], laser_poses[n, k] / resolution_m)
            high[k] = max(high[k], laser_poses[n, k] / resolution_m)
    return ends, kinds


@numba.njit(cache=True)
def _trace(
    state: NDArray[np.int32],  # (H, W), in place: steps above LOWEST, and 256 times the last scan that spoke of it
    starts: Array,  # (n, 2) of the laser, in cells
    ends: Array,  # (n, B, 2) of the beams
    kinds: NDArray[np.int8],  # (n, B)
    scans_before: int,
) -> None:
    # flat unsigned indices, and the paces in fixed point: a third faster than two signed ones of floats
    cells, columns, beams = state.reshape(-1), np.int64(state.shape[1]), ends.shape[1]
    one = np.int64(1) << BITS
    paces = np.zeros((beams, 2), np.int64)  # one cell at a time along the longer side
    counts = np.zeros(beams, np.int64)  # of them
    for scan in range(len(starts)):
        x0, y0 = starts[scan]
        spoken = np.int32((scans_before + scan + 1) << 8)
        for beam in range(beams):
            counts[beam] = 0
            if kinds[scan, beam] == NOTHING:
                continue
            x1, y1 = ends[scan, beam]
            dx, dy = x1 - x0, y1 - y0
            length = max(abs(dx), abs(dy))
            counts[beam] = np.int64(length)
            if counts[beam] > 0:
                paces[beam, 0], paces[beam, 1] = np.int64(dx / length * one), np.int64(dy / length * one)
            if kinds[scan, beam] == HITS:
                cell = np.uint64(np.int64(y1) * columns + np.int64(x1))
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
def _settle(state: NDArray[np.int32]) -> NDArray[np.int8]:
    """The steps of the cells: in one pass, for pages of memory cost more than what is reckoned on them."""
    out = np.empty(state.shape, np.int8)
    steps, cells = out.reshape(-1), state.reshape(-1)
    for k in range(len(cells)):
        steps[k] = (cells[k] & 255) + LOWEST
    return out


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
