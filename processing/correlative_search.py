"""Correlative scan matching: of all poses of a window, the one from which most of a scan's points lie on walls.

In: an image of the walls and the points of a scan, all in cells. Out: the shift and heading with the largest sum of
the image under the points; of several as good, the first. All are as good as tried (Olson 2009, section V): blocks of
BLOCK × BLOCK shifts are bounded by an image that holds the largest value of as many cells, and only blocks whose bound
is no less than what was found are looked at.
"""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

BLOCK = 4


@njit(cache=True)
def _bounds_of(field: Image) -> NDArray[np.uint8]:
    """The largest value of BLOCK × BLOCK cells of a field (H, W) from each corner on, also those that begin before it.

    That of the block from cell (4 i + a - 4, 4 j + b - 4) on stands at [a, b, i, j]: blocks in a row lie together.
    """
    height, width = field.shape
    out = np.zeros((BLOCK, BLOCK, height // BLOCK + 2, width // BLOCK + 2), np.uint8)
    for row in range(height):
        for column in range(width):
            value = field[row, column]
            if value == 0:
                continue
            for y in range(row + 1, row + BLOCK + 1):  # corners from row - 3 to row, counted from -4
                for x in range(column + 1, column + BLOCK + 1):
                    at = out[y % BLOCK, x % BLOCK]
                    i, j = y // BLOCK, x // BLOCK
                    at[i, j] = max(at[i, j], value)
    return out


@njit(cache=True)
def _sum(field: Image, rows: NDArray[np.int64], columns: NDArray[np.int64], dy: int, dx: int) -> int:
    height, width = field.shape
    total = 0
    for i in range(len(rows)):
        row, column = rows[i] + dy, columns[i] + dx
        if 0 <= row < height and 0 <= column < width:
            total += field[row, column]
    return total


@njit(cache=True)
def search_window(
    field: Image, start: Array, headings: Array, points: Array, radius: float
) -> tuple[tuple[int, int, int], int]:
    """The best shift (dx, dy) of no more than `radius` each way from `start` (2,), the number of the best of the
    headings, and the sum there; `field` (H, W), `points` (n, 2) around the scanner. All but the headings in cells.
    """
    cells = math.ceil(radius)
    side = 2 * cells + 1
    blocks = (side + BLOCK - 1) // BLOCK
    largest = _bounds_of(field)
    rows, columns = np.empty((len(headings), len(points)), np.int64), np.empty((len(headings), len(points)), np.int64)
    bounds = np.zeros((len(headings), blocks, blocks), np.int32)
    for k in range(len(headings)):
        c, s = math.cos(headings[k]), math.sin(headings[k])
        for i in range(len(points)):
            columns[k, i] = math.floor(start[0] + c * points[i, 0] - s * points[i, 1]) - cells
            rows[k, i] = math.floor(start[1] + s * points[i, 0] + c * points[i, 1]) - cells
            y, x = rows[k, i] + BLOCK, columns[k, i] + BLOCK
            at = largest[y % BLOCK, x % BLOCK]
            y, x = y // BLOCK, x // BLOCK
            first, last = max(0, -x), min(blocks, at.shape[1] - x)
            for by in range(max(0, -y), min(blocks, at.shape[0] - y)):
                for bx in range(first, last):
                    bounds[k, by, bx] += at[y + by, x + bx]
    best, best_sum = (0, 0, 0), 0
    flat = bounds.ravel()
    for n in np.argsort(-flat, kind="mergesort"):
        if flat[n] < max(best_sum, 1):
            break
        k, by, bx = n // (blocks * blocks), n // blocks % blocks, n % blocks
        for dy in range(by * BLOCK, min(by * BLOCK + BLOCK, side)):
            for dx in range(bx * BLOCK, min(bx * BLOCK + BLOCK, side)):
                total = _sum(field, rows[k], columns[k], dy, dx)
                place = (k, dy, dx)
                if total > best_sum or (total == best_sum and place < best):
                    best, best_sum = place, total
    return (best[2] - cells, best[1] - cells, best[0]), best_sum
