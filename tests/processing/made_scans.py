"""Scans of walls that a test draws itself."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from processing.geometry import compose
from processing.scan_walls import Scan, prepare_scan
from processing.simulation.raycast import SegmentGrid, build_grid, cast

ANGLES = np.radians(np.linspace(-135, 135, 541))
MOUNT = np.array([-0.6, 0.1, np.pi])
SPACING_M = 0.5
NOISE_M = 0.01


def walls(*lines: Sequence[tuple[float, float]], roughness_m: float = 0.0) -> SegmentGrid:
    """Walls along polylines, of rock that is so rough every half metre."""
    pieces, rng = [], np.random.default_rng(4)
    for a, b in (pair for line in lines for pair in pairwise(np.array(line, float))):
        points = a + np.linspace(0, 1, int(np.hypot(*(b - a)) / SPACING_M) + 2)[:, None] * (b - a)
        points[1:-1] += rng.normal(0, roughness_m, (len(points) - 2, 2))
        pieces.append(np.hstack([points[:-1], points[1:]]))
    return build_grid(np.concatenate(pieces))


def look(world: SegmentGrid, pose: np.ndarray, seed: int) -> Scan:
    """What the scanner of a vehicle at a pose (3,) sees, no further than 20 m."""
    laser, rng = compose(pose, MOUNT), np.random.default_rng(seed)
    ranges = cast(world, np.tile(laser[:2], (len(ANGLES), 1)), laser[2] + ANGLES, 20.0)
    ranges = np.where(np.isfinite(ranges), ranges + rng.normal(0, NOISE_M, len(ranges)), np.nan)
    points = ranges[:, None] * np.column_stack([np.cos(ANGLES), np.sin(ANGLES)])
    return prepare_scan(points, ANGLES[0], ANGLES[1] - ANGLES[0], MOUNT)
