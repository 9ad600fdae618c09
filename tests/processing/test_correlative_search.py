"""The search of a window by bounds finds what a search of every pose finds."""

import numpy as np
import pytest

from processing.correlative_search import search_window


def every_pose(
    field: np.ndarray, start: np.ndarray, headings: np.ndarray, points: np.ndarray, radius: float
) -> tuple[tuple[int, int, int], int]:
    cells = int(np.ceil(radius))
    shifts = np.arange(-cells, cells + 1)
    best, best_sum = (0, 0, 0), -1
    for k, heading in enumerate(headings):
        c, s = np.cos(heading), np.sin(heading)
        column, row = np.floor(start[:, None] + np.array([[c, -s], [s, c]]) @ points.T).astype(int)
        rows, columns = row + shifts[:, None, None], column + shifts[:, None]
        inside = (rows >= 0) & (rows < field.shape[0]) & (columns >= 0) & (columns < field.shape[1])
        values = field[np.clip(rows, 0, field.shape[0] - 1), np.clip(columns, 0, field.shape[1] - 1)]
        sums = np.where(inside, values, 0).astype(int).sum(axis=-1)
        dy, dx = np.unravel_index(int(np.argmax(sums)), sums.shape)
        if sums[dy, dx] > best_sum:
            best, best_sum = (int(shifts[dx]), int(shifts[dy]), k), int(sums[dy, dx])
    return best, best_sum


@pytest.mark.parametrize("seed", range(12))
def test_the_same_as_of_every_pose(seed: int) -> None:
    """Rooms and drifts, whole and cut off by the edge of the image; of several as good, the first."""
    rng = np.random.default_rng(seed)
    field = np.zeros(rng.integers(3, 70, 2), np.uint8)
    for _ in range(6):
        field[rng.integers(field.shape[0]), rng.integers(field.shape[1]) :] = 4
        field[: rng.integers(1, field.shape[0] + 1), rng.integers(field.shape[1])] = rng.integers(1, 5)
    points = np.concatenate([np.column_stack([np.linspace(-20, 20, 40), np.full(40, y)]) for y in (-6.3, 5.1)])
    points += rng.normal(0, 0.3, points.shape)
    start = rng.uniform(-10, field.shape[::-1] + np.array([10, 10]))
    headings = rng.uniform(-3, 3) + np.arange(-0.4, 0.4, 0.05)
    radius = rng.uniform(0, 15)
    assert search_window(field, start, headings, points, radius) == every_pose(field, start, headings, points, radius)


def test_where_nothing_is_nothing_is_found() -> None:
    empty = np.zeros((9, 9), np.uint8)
    for field, points in ((empty, np.ones((5, 2))), (empty + 4, np.zeros((0, 2))), (empty + 4, np.full((5, 2), 1e3))):
        assert search_window(field, np.full(2, 4.0), np.zeros(3), points, 6.0)[1] == 0
