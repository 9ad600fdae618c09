"""Stitching: many occupancy grids, each with its place, into one.

In: grids and poses. Out: a grid of the whole plane that they cover, or of a window of it, so that a map too large for
the memory is made window by window. Source: appendix A of Lavigne & Marshall 2012, read backwards: from the cells of
the whole to those of the part, so that no turn leaves holes.
"""

import math
from collections.abc import Sequence

import numba
import numpy as np
from numpy.typing import NDArray

from processing.geometry import Array, inverse, transform
from processing.occupancy_grid import Grid, StoredGrid, Window


def stitched_window(grids: Sequence[Grid | StoredGrid], placements: Array) -> Window:
    """What the grids cover together. Raises: ValueError: there is no grid, or their resolutions differ."""
    if not grids or len(grids) != len(placements) or len({grid.window.resolution_m for grid in grids}) != 1:
        raise ValueError(f"{len(grids)} grids and {len(placements)} placements do not make one map of one resolution")
    resolution_m = grids[0].window.resolution_m
    corners = np.concatenate([_corners(grid.window, pose) for grid, pose in zip(grids, placements, strict=True)])
    low = np.floor(corners.min(axis=0) / resolution_m + 1e-6)
    width, height = (np.ceil(corners.max(axis=0) / resolution_m - 1e-6) - low).astype(int).tolist()
    return Window((height, width), resolution_m, low * resolution_m)


def rows_covered(part: Window, pose: Array, whole: Window) -> tuple[int, int]:
    """The first row of a window that a part placed at `pose` (3,) reaches, and the one after the last."""
    rows = (_corners(part, pose)[:, 1] - whole.origin[1]) / whole.resolution_m
    return int(np.floor(rows.min())), int(np.ceil(rows.max()))


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
    last = np.minimum(np.ceil(corners.max(axis=0)), whole.cells.shape[::-1]).astype(int)
    if np.any(first >= last):
        return
    # the centre of cell [0, 0] of the whole, and the pose's turn, seen from the part in its cells
    back = inverse(pose)
    start = (transform(back, whole.origin + resolution_m / 2) - part.window.origin) / resolution_m - 0.5
    turn = np.array([np.cos(back[2]), np.sin(back[2])])
    _resample(whole.cells, part.load().cells, part.unit, start, turn, first, last)


@numba.njit(cache=True)
def _resample(
    whole: NDArray[np.float32 | np.int8],  # (H, W) of floats, changed in place
    part: NDArray[np.float32 | np.int8],  # (h, w)
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
