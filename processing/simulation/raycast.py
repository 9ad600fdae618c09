"""Ray casting: how far a beam flies until it meets a wall.

In: wall segments, beams. Out: distances. The segments lie in the cells of a uniform grid, and a beam looks only at the
cells it crosses, in order (Amanatides & Woo 1987), until a hit is nearer than the cell's far side.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]
CELL_M = 0.5
ROUNDING = 1e-9  # so that no beam slips between two segments that share an end


@dataclass(frozen=True, slots=True)
class SegmentGrid:
    """Cell (i, j) = [row, column] holds the segments `members[starts[c]:starts[c + 1]]`, c = i * columns + j."""

    segments: Array  # (n, 4) x1, y1, x2, y2
    origin: Array  # (2,) the lower left corner
    rows: int
    columns: int
    starts: NDArray[np.int64]
    members: NDArray[np.int64]


def build_grid(segments: Array) -> SegmentGrid:
    """Sort segments (n, 4) into cells: each into all the cells of its bounding box, so they had better be short."""
    low = np.minimum(segments[:, :2], segments[:, 2:])
    high = np.maximum(segments[:, :2], segments[:, 2:])
    origin = low.min(axis=0) - CELL_M
    columns, rows = (np.ceil((high.max(axis=0) - origin) / CELL_M).astype(int) + 1).tolist()
    first = ((low - origin) / CELL_M).astype(np.int64)
    last = ((high - origin) / CELL_M).astype(np.int64)
    width, height = (last - first + 1).T
    owner = np.repeat(np.arange(len(segments)), width * height)
    rank = np.arange(len(owner)) - np.repeat(np.cumsum(width * height) - width * height, width * height)
    cell = (first[owner, 1] + rank // width[owner]) * columns + first[owner, 0] + rank % width[owner]
    order = np.argsort(cell, kind="stable")
    starts = np.searchsorted(cell[order], np.arange(rows * columns + 1))
    return SegmentGrid(segments, origin, rows, columns, starts, owner[order])


def cast(grid: SegmentGrid, origins: Array, angles: Array, longest_m: float) -> Array:
    """Distances (m,) of beams from origins (m, 2) at angles (m,) in the world frame; +inf without a hit in range."""
    return np.asarray(
        _cast(
            grid.segments, grid.origin, grid.rows, grid.columns, grid.starts, grid.members, origins, angles, longest_m
        )
    )


@njit(cache=True)
def _cast(segments, corner, rows, columns, starts, members, origins, angles, longest):  # type: ignore[no-untyped-def]
    distances = np.full(len(angles), np.inf)
    for beam in range(len(angles)):
        x, y = origins[beam, 0], origins[beam, 1]
        dx, dy = np.cos(angles[beam]), np.sin(angles[beam])
        column, row = int(np.floor((x - corner[0]) / CELL_M)), int(np.floor((y - corner[1]) / CELL_M))
        step_x, step_y = (1 if dx > 0 else -1), (1 if dy > 0 else -1)
        # distance along the beam to the next border of a column and of a row, and between two borders
        span_x = CELL_M / abs(dx) if dx != 0 else np.inf
        span_y = CELL_M / abs(dy) if dy != 0 else np.inf
        next_x = (corner[0] + (column + (dx > 0)) * CELL_M - x) / dx if dx != 0 else np.inf
        next_y = (corner[1] + (row + (dy > 0)) * CELL_M - y) / dy if dy != 0 else np.inf
        nearest = longest
        hit = False
        while 0 <= column < columns and 0 <= row < rows:
            cell = row * columns + column
            for k in range(starts[cell], starts[cell + 1]):
                segment = segments[members[k]]
                ex, ey = segment[2] - segment[0], segment[3] - segment[1]
                denominator = dx * ey - dy * ex
                if denominator == 0.0:
                    continue  # parallel: its neighbours, at an angle, stop the beam
                wx, wy = segment[0] - x, segment[1] - y
                along = (wx * ey - wy * ex) / denominator
                across = (wx * dy - wy * dx) / denominator
                if 0.0 <= along <= nearest and -ROUNDING <= across <= 1.0 + ROUNDING:
                    nearest = along
                    hit = True
            border = min(next_x, next_y)
            if border > nearest:
                break
            if next_x < next_y:
                column += step_x
                next_x += span_x
            else:
                row += step_y
                next_y += span_y
        if hit:
            distances[beam] = nearest
    return distances
