"""Precision and recall of walls: one for a perfect map, low for a wall drawn twice or not at all."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from processing.wall_evaluation import score_walls, seen_wall_cells

LENGTH, HALF = 40.0, 2.0
WALLS = np.array(
    [[0, -HALF, LENGTH, -HALF], [0, HALF, LENGTH, HALF], [0, -HALF, 0, HALF], [LENGTH, -HALF, LENGTH, HALF]]
)
DRIVE = np.column_stack([np.linspace(2, 38, 200), np.zeros((200, 2))])
ALONG = np.arange(0, LENGTH, 0.05) + 0.025


def drawn(*offsets: float, along: np.ndarray = ALONG) -> np.ndarray:
    """Occupied cells of both long walls, each drawn once for every offset towards the outside [m]."""
    sides = [np.column_stack([along, np.full(len(along), s * (HALF + d))]) for s in (-1, 1) for d in offsets]
    return np.concatenate(sides)


def test_a_perfect_map() -> None:
    score = score_walls(drawn(0.0), WALLS, [DRIVE])
    assert (score.precision, score.recall, score.occupied_cells) == (1.0, 1.0, 1600)
    assert score.seen_cells > 1500


@pytest.mark.parametrize(("offset", "kept"), [(0.09, 1.0), (0.11, 0.0)])
def test_two_cells_are_forgiven_and_no_more(offset: float, kept: float) -> None:
    score = score_walls(drawn(offset), WALLS, [DRIVE])
    assert_allclose([score.precision, score.recall], kept, atol=0.01)


def test_a_wall_drawn_twice_costs_precision_alone() -> None:
    score = score_walls(drawn(0.0, 0.4), WALLS, [DRIVE])
    assert_allclose([score.precision, score.recall], [0.5, 1.0], atol=0.01)


def test_half_a_wall_costs_recall_alone() -> None:
    score = score_walls(drawn(0.0, along=ALONG[:400]), WALLS, [DRIVE])
    assert_allclose([score.precision, score.recall], [1.0, 0.5], atol=0.02)


def test_an_empty_map() -> None:
    score = score_walls(np.zeros((0, 2)), WALLS, [DRIVE])
    assert (score.precision, score.recall) == (0.0, 0.0)


def test_walls_out_of_sight_are_not_asked_for() -> None:
    behind = np.array([[0, -HALF - 1, LENGTH, -HALF - 1], [0, 50, 40, 50]])
    assert len(seen_wall_cells(np.vstack([WALLS, behind]), [DRIVE])) == len(seen_wall_cells(WALLS, [DRIVE]))
    ends = seen_wall_cells(WALLS, [DRIVE])
    assert np.abs(np.abs(ends[:, 1]) - HALF).max() < 1e-6  # the dead ends lie ahead and astern
