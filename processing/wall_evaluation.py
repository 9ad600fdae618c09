"""Walls drawn against walls built: precision and recall of the occupied cells of a map.

In: the map's occupied cells in the true frame, the true walls as segments, the true trajectories. Out: two shares.

    precision   of the occupied cells, those with a true wall within `TOLERANCE_M`: a wall drawn twice lowers it
    recall      of the true wall cells that the scanner must have seen, those with an occupied cell within `TOLERANCE_M`

Seen must have been what lies, with nothing before it, within `SIGHT_M` of the true trajectory at 45° … 135° to the left
or right of the vehicle: a scanner of 270° has that sector in view whether it looks ahead or astern.
"""

from dataclasses import dataclass

import numpy as np
import shapely
from scipy.spatial import cKDTree

from processing.geometry import Array
from processing.simulation.raycast import build_grid, cast

TOLERANCE_M = 0.1  # two cells
CELL_M = 0.05
SIGHT_M = 10.0
LOOK_EVERY_M = 0.25
STOPS_AT_ONCE = 1000
BEARINGS = np.radians(np.concatenate([np.arange(45, 135, 0.25), np.arange(-135, -45, 0.25)]))


@dataclass(frozen=True, slots=True)
class WallScore:
    tolerance_m: float
    occupied_cells: int
    precision: float
    seen_cells: int
    recall: float


def score_walls(occupied: Array, walls: Array, trajectories: list[Array]) -> WallScore:
    """Precision and recall of occupied cell centres (n, 2) against walls (w, 4) of x1, y1, x2, y2.

    Args:
        occupied: In the frame of the walls.
        walls: Segments.
        trajectories: True poses (n, 3) of each run.
    """
    seen = seen_wall_cells(walls, trajectories)
    tree = shapely.STRtree(shapely.linestrings(walls.reshape(-1, 2, 2)))
    near = np.unique(tree.query(shapely.points(occupied), "dwithin", TOLERANCE_M)[0])
    found = np.zeros(len(seen), dtype=bool)
    if len(occupied) and len(seen):
        found = cKDTree(occupied).query(seen, distance_upper_bound=TOLERANCE_M)[0] <= TOLERANCE_M
    return WallScore(
        tolerance_m=TOLERANCE_M,
        occupied_cells=len(occupied),
        precision=len(near) / len(occupied) if len(occupied) else 0.0,
        seen_cells=len(seen),
        recall=float(found.mean()) if len(seen) else 0.0,
    )


def seen_wall_cells(walls: Array, trajectories: list[Array]) -> Array:
    """One point (m, 2) on the wall for every cell of a wall that was in view from the trajectories."""
    grid, points = build_grid(walls), np.zeros((0, 2))
    for stops in (block for poses in trajectories for block in _stops(poses)):
        origins, angles = np.repeat(stops[:, :2], len(BEARINGS), axis=0), (stops[:, 2:] + BEARINGS).ravel()
        distances = cast(grid, origins, angles, SIGHT_M)
        hit = np.isfinite(distances)
        directions = np.column_stack([np.cos(angles), np.sin(angles)])
        points = np.concatenate([points, origins[hit] + distances[hit, None] * directions[hit]])
        _, first = np.unique(np.floor(points / CELL_M).astype(np.int64), axis=0, return_index=True)
        points = points[first]
    return points


def _stops(poses: Array) -> list[Array]:
    """The poses at every `LOOK_EVERY_M` of a drive, in blocks that bound the memory."""
    driven = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1))])
    stops = poses[np.unique(np.searchsorted(driven, np.arange(0, driven[-1] + 1e-9, LOOK_EVERY_M)))]
    return [stops[k : k + STOPS_AT_ONCE] for k in range(0, len(stops), STOPS_AT_ONCE)]
