"""Does a scan object to where the wheels say the vehicle is? And does all of it, or one thing in view alone?

In: two scans, the pose that their match found and the pose that the wheels tell. Out: by how much worse the walls fit
at the wheels' pose, on a scale from 0 (a smooth drift fits anywhere along it) to 1 (nothing fits there).

    the vehicle drives, a truck ahead drives along:         all walls fit the wheels, one piece of the view objects
    the wheels slip, the drift is rough:                    every piece of the view objects

A witness that can be moved by one thing in view convicts nobody: what objects most in a row of bearings is left out
before the rest is asked. So a vehicle ahead, a door or a heap that has changed, cannot overrule the wheels; walls can.
"""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from processing.scan_matching import nearest_wall
from processing.scan_walls import BEARING_RAD, FUSED, Scan, bearing

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

SECTORS = 24  # of 15°
LEFT_OUT = 6  # sectors in a row: a vehicle 2.5 m wide and 1.3 m ahead
FAR_M = 0.5  # walls further from a point are not its own
MISFIT = 9.0  # squared standard deviations at which a point fits no better than one without a wall
LEAST_POINTS = 30  # fewer than that cannot object


@njit(cache=True, error_model="numpy", fastmath=FUSED)
def _misfits(
    ref_points: Array,
    ref_normals: Array,
    ref_variances: Array,
    angle_min: float,
    increment: float,
    bent: float,
    points: Array,
    normals: Array,
    range_noise_m: float,
    poses: Array,  # (2, 3)
    sums: Array,  # (2, SECTORS)
    counts: Ints,  # (SECTORS,)
) -> None:
    """Sum up how badly the points fit at both poses, each between 0 and 1; those that the first does not see do not
    count.
    """
    beams, bent = ref_points.shape[0], bent + BEARING_RAD
    costs = np.zeros(2)
    for i in range(len(points)):
        if not math.isfinite(normals[i, 0]):
            continue
        px, py = points[i, 0], points[i, 1]
        seen = True
        for p in range(2):
            c, s = math.cos(poses[p, 2]), math.sin(poses[p, 2])
            x, y = c * px - s * py + poses[p, 0], s * px + c * py + poses[p, 1]
            nx, ny = c * normals[i, 0] - s * normals[i, 1], s * normals[i, 0] + c * normals[i, 1]
            distance = math.sqrt(x * x + y * y)
            seen_at = bearing(x, y) - angle_min
            if seen_at < 0:
                seen_at += 2 * math.pi
            middle = int(seen_at / increment + 0.5)
            best = nearest_wall(ref_points, ref_normals, increment, bent, middle, (x, y, nx, ny, distance), FAR_M)
            if best >= 0:
                error = ref_normals[best, 0] * (x - ref_points[best, 0]) + ref_normals[best, 1] * (
                    y - ref_points[best, 1]
                )
                variance = ref_variances[best, 0] + range_noise_m * range_noise_m
                costs[p] = min(error * error / (MISFIT * variance), 1.0)
            elif p == 1 or (middle < beams and distance < math.hypot(ref_points[middle, 0], ref_points[middle, 1])):
                costs[p] = 1.0  # also where it would lie out of sight: what is seen speaks for where it is
            else:
                seen = False
        if seen:
            sector = int((bearing(px, py) + math.pi) / (2 * math.pi) * SECTORS) % SECTORS
            sums[0, sector] += costs[0]
            sums[1, sector] += costs[1]
            counts[sector] += 1


def objection(reference: Scan, current: Scan, matched: Array, wheels: Array) -> float:
    """By how much worse the scans fit at `wheels` (3,) than at `matched` (3,), poses of the current scanner in the
    frame of the reference scanner: the mean over the points, without those of the bearings that object most.
    """
    sums, counts = np.zeros((2, SECTORS)), np.zeros(SECTORS, np.int64)
    _misfits(
        reference.points,
        reference.normals,
        reference.variances,
        reference.angle_min,
        reference.angle_increment,
        reference.bent_rad,
        current.points,
        current.normals,
        current.range_noise_m,
        np.stack([matched, wheels]),
        sums,
        counts,
    )
    worse = sums[1] - sums[0]
    rows = (np.arange(SECTORS)[:, None] + np.arange(LEFT_OUT)) % SECTORS
    loudest = rows[np.argmax(worse[rows].sum(axis=1))]
    left = int(counts.sum() - counts[loudest].sum())
    if left < LEAST_POINTS:
        return 0.0
    return float((worse.sum() - worse[loudest].sum()) / left)
