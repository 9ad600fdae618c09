"""What scans object to: walls that are rough, wherever one looks; not smooth ones, and not one thing in view alone."""

import numpy as np

from processing.chain import NEUTRAL, OBJECTS
from processing.objection import objection
from processing.scan_walls import Scan, prepare_scan

ANGLES = np.radians(np.linspace(-135, 135, 541))
MOVED = np.array([0.4, 0.0, 0.0])


def drift(roughness_m: float) -> np.ndarray:
    """Segments (n, 4) of two walls along x, 4.4 m apart."""
    rng, walls = np.random.default_rng(4), []
    x = np.arange(-30, 50, 0.5)
    for y in (2.2, -2.2):
        points = np.column_stack([x, y + rng.normal(0, roughness_m, len(x))])
        walls.append(np.hstack([points[:-1], points[1:]]))
    return np.concatenate(walls)


def truck(ahead_m: float) -> np.ndarray:
    x, y = ahead_m, 1.2
    return np.array([[x, -y, x, y], [x, y, x + 5, y], [x, -y, x + 5, -y]])


def look(segments: np.ndarray, x: float, seed: int) -> Scan:
    """A scan from (x, 0) along the drift."""
    ray = np.column_stack([np.cos(ANGLES), np.sin(ANGLES)])
    start, along = segments[:, :2] - [x, 0.0], segments[:, 2:] - segments[:, :2]
    with np.errstate(divide="ignore", invalid="ignore"):
        crossed = ray[:, :1] * along[:, 1] - ray[:, 1:] * along[:, 0]
        far = (start[:, 0] * along[:, 1] - start[:, 1] * along[:, 0]) / crossed
        at = (start[:, 0] * ray[:, 1:] - start[:, 1] * ray[:, :1]) / crossed
    ranges = np.where((far > 0) & (at >= 0) & (at <= 1), far, np.inf).min(axis=1)
    ranges += np.random.default_rng(seed).normal(0, 0.01, len(ranges))
    points = np.where(ranges < 20, ranges, np.nan)[:, None] * ray
    return prepare_scan(points, ANGLES[0], ANGLES[1] - ANGLES[0])


def test_rough_walls_object_to_a_step_that_was_not_made() -> None:
    walls = drift(0.15)
    before, after = look(walls, 0.0, 1), look(walls, 0.4, 2)
    assert objection(before, after, MOVED, np.zeros(3)) > 3 * OBJECTS
    assert objection(before, after, np.zeros(3), MOVED) < -3 * OBJECTS  # they object to the lie, whoever tells it


def test_smooth_walls_do_not() -> None:
    before, after = look(drift(0.0), 0.0, 1), look(drift(0.0), 0.4, 2)
    assert abs(objection(before, after, MOVED, np.zeros(3))) < NEUTRAL


def test_smooth_walls_object_to_a_turn() -> None:
    before, after = look(drift(0.0), 0.0, 1), look(drift(0.0), 0.4, 2)
    assert objection(before, after, MOVED, MOVED + np.array([0.0, 0.0, 0.05])) > 3 * OBJECTS


def test_a_truck_that_drives_ahead_objects_alone_and_is_not_heard() -> None:
    """By the truck the vehicle stands still; the walls do not mind that it drives."""
    before = look(np.concatenate([drift(0.0), truck(4.0)]), 0.0, 1)
    after = look(np.concatenate([drift(0.0), truck(4.4)]), 0.4, 2)
    assert objection(before, after, np.zeros(3), MOVED) < OBJECTS


def test_a_scan_of_almost_nothing_objects_to_nothing() -> None:
    walls = drift(0.15)
    few = look(walls, 0.4, 2).points.copy()
    few[np.arange(len(few)) % 90 > 5] = np.nan  # a few beams here and there
    assert objection(look(walls, 0.0, 1), prepare_scan(few, ANGLES[0], ANGLES[1] - ANGLES[0]), MOVED, np.zeros(3)) == 0
