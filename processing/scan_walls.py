"""The walls of a scan: the line through each of its points, as the matching of scans wants them.

In: points in the scanner's frame, by ascending bearing. Out: a `Scan`: at each point the normal of the wall, and how
sure point and normal are. A rough wall is known from the few points around; a smooth one from two metres of it, so that
its direction is known to a milliradian: how else would a match know along which way it sees nothing? A wall goes on
across beams that have no return, as on dark wet rock, or met dust.
"""

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hw_profiles.profile import Laser
from processing.solid_returns import solid_returns

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

RANGE_NOISE_M = Laser().range_noise_m
WALL_LENGTH_M = 0.35  # a normal is fitted to at least this much wall, where there are enough points
MAX_NEIGHBOURS = 12
SMOOTH_M = 2.0  # a wall this far straight, to as much as noise lets one see, is smooth
CHANCE = 2.0  # standard deviations by which its residuals may exceed the noise
GRAZING = 6.0  # neighbouring points further apart than this many times r·Δφ see no wall, or see it at less than 10°
NEAR_M = 0.15  # nearer than this they see one wall in any case
MAX_GAP = 16  # beams from one return to the next, where all in between say nothing; and
MAX_GAP_M = 1.0  # metres, lest the ends of two walls far down a drift be joined across it
BEARING_RAD = 2.5e-4  # how far off `bearing` may be
AT_ORIGIN = np.zeros(3)
FUSED = {"contract", "nsz", "arcp"}  # what compilers may do to sums and quotients; NaN stays NaN


@dataclass(frozen=True, slots=True)
class Scan:
    """A scan ready for matching, in its own frame: x ahead of the scanner, y left; B beams by ascending bearing."""

    points: Array  # (B, 2) m; without a return: NaN
    normals: Array  # (B, 2) towards the scanner; NaN where no wall could be fitted
    variances: Array  # (B, 2): of the point off its line [m²], of the normal's direction [rad²]
    angle_min: float
    angle_increment: float
    bent_rad: float  # how far off its beam's bearing a point lies at most: the motion during the sweep was removed
    mount: Array  # (3,) where the scanner sits in its vehicle: runs of one mine have different ones
    range_noise_m: float = RANGE_NOISE_M


@njit(cache=True, error_model="numpy", fastmath=FUSED)
def bearing(x: float, y: float) -> float:
    """The bearing of a point, a polynomial in place of the arctangent: to know where to look, BEARING_RAD will do."""
    ax, ay = abs(x), abs(y)
    larger = max(ax, ay)
    t = min(ax, ay) / larger if larger > 0 else 0.0
    q = t * t
    angle = ((-0.0464964749 * q + 0.15931422) * q - 0.327622764) * q * t + t
    if ay > ax:
        angle = math.pi / 2 - angle
    if x < 0:
        angle = math.pi - angle
    return -angle if y < 0 else angle


@njit(cache=True)
def _stretches(points: Array, joined: NDArray[np.bool_]) -> tuple[Array, Ints, Ints]:
    """Sums (K + 1, 5) of x, y, x², xy, y² over all points before each; and for each point the first and the last (K, 2)
    of those in a row with it, and of those in a row that lie within SMOOTH_M.
    """
    count = points.shape[0]
    sums, rows, ends = np.zeros((count + 1, 5)), np.zeros((count, 2), np.int64), np.zeros((count, 2), np.int64)
    first = last = 0
    for i in range(count):
        x, y = points[i, 0], points[i, 1]
        sums[i + 1, 0] = sums[i, 0] + x
        sums[i + 1, 1] = sums[i, 1] + y
        sums[i + 1, 2] = sums[i, 2] + x * x
        sums[i + 1, 3] = sums[i, 3] + x * y
        sums[i + 1, 4] = sums[i, 4] + y * y
        if i > 0 and not joined[i - 1]:
            first = i
        rows[i, 0] = rows[i - 1, 0] if i > 0 and joined[i - 1] else i
        while first < i and (points[first, 0] - x) ** 2 + (points[first, 1] - y) ** 2 > SMOOTH_M * SMOOTH_M:
            first += 1
        last = max(last, i)
        while joined[last] and (points[last + 1, 0] - x) ** 2 + (points[last + 1, 1] - y) ** 2 <= SMOOTH_M * SMOOTH_M:
            last += 1
        ends[i, 0], ends[i, 1] = first, last
    for i in range(count - 1, -1, -1):
        rows[i, 1] = rows[i + 1, 1] if joined[i] else i
    return sums, rows, ends


@njit(cache=True, error_model="numpy", fastmath=FUSED)
def _scatter(sums: Array, first: int, last: int) -> tuple[float, float, float]:
    """xx, xy, yy of the points from `first` to `last` about their mean, times their number."""
    n = last - first + 1
    x, y = sums[last + 1, 0] - sums[first, 0], sums[last + 1, 1] - sums[first, 1]
    xx, xy = sums[last + 1, 2] - sums[first, 2], sums[last + 1, 3] - sums[first, 3]
    return xx - x * x / n, xy - x * y / n, sums[last + 1, 4] - sums[first, 4] - y * y / n


@njit(cache=True, error_model="numpy", fastmath=FUSED)
def _join(points: Array, beams: Ints, increment: float) -> NDArray[np.bool_]:
    """Do a point (K, 2) of these beams and the next lie on one wall? (K,)"""
    joined = np.zeros(len(beams), np.bool_)
    for i in range(len(beams) - 1):
        gap = beams[i + 1] - beams[i]
        dx, dy = points[i + 1, 0] - points[i, 0], points[i + 1, 1] - points[i, 1]
        furthest = GRAZING * increment * math.sqrt(points[i, 0] * points[i, 0] + points[i, 1] * points[i, 1])
        furthest = max(NEAR_M, furthest, min(gap * furthest, MAX_GAP_M))
        joined[i] = gap <= MAX_GAP and math.sqrt(dx * dx + dy * dy) < furthest
    return joined


@njit(cache=True, error_model="numpy", fastmath=FUSED)
def _fit_walls(
    all_points: Array, angle_min: float, increment: float, range_noise_m: float, normals: Array, variances: Array
) -> float:
    """A line through each point and as many neighbours as span WALL_LENGTH_M: its normal, and how sure both are.

    Returns: how far off its beam's bearing a point lies at most [rad].
    """
    normals[:] = np.nan
    variances[:] = np.nan
    beams = solid_returns(all_points, range_noise_m)
    count, least_variance, bent = len(beams), range_noise_m * range_noise_m, 0.0
    points = np.empty((count, 2))
    for i in range(count):
        points[i, 0], points[i, 1] = all_points[beams[i], 0], all_points[beams[i], 1]
        off = bearing(points[i, 0], points[i, 1]) - (angle_min + beams[i] * increment)
        bent = max(bent, abs(off - 2 * math.pi * round(off / (2 * math.pi))))
    joined = _join(points, beams, increment)
    sums, rows, ends = _stretches(points, joined)
    for i in range(count):
        if i == 0 or i == count - 1 or not (joined[i - 1] and joined[i]):
            continue
        # Grow to both sides, a beam at a time.
        leftmost, rightmost = max(rows[i, 0], i - MAX_NEIGHBOURS), min(rows[i, 1], i + MAX_NEIGHBOURS)
        low = high = i
        while low > leftmost or high < rightmost:
            low, high = max(low - 1, leftmost), min(high + 1, rightmost)
            if high - low >= 4:
                dx, dy = points[high, 0] - points[low, 0], points[high, 1] - points[low, 1]
                if dx * dx + dy * dy > WALL_LENGTH_M * WALL_LENGTH_M:
                    break
        n = high - low + 1
        if n < 4:
            continue
        sxx, sxy, syy = _scatter(sums, low, high)
        # A smooth wall is known better from a longer stretch of it: to both sides, or, at its ends, to one.
        for a, b in ((ends[i, 0], ends[i, 1]), (ends[i, 0], i + 1), (i - 1, ends[i, 1])):
            dx, dy = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1]
            m = b - a + 1
            if m > n and dx * dx + dy * dy > SMOOTH_M * SMOOTH_M:
                txx, txy, tyy = _scatter(sums, a, b)
                rest = 0.5 * (txx + tyy) - math.sqrt(0.25 * (txx - tyy) ** 2 + txy * txy)
                if rest < least_variance * (m - 2 + CHANCE * math.sqrt(2.0 * (m - 2))):
                    n, sxx, sxy, syy = m, txx, txy, tyy
                    break
        # The larger eigenvalue of the scatter, and its direction: the wall's.
        half = 0.5 * (sxx - syy)
        root = math.sqrt(half * half + sxy * sxy)
        along = 0.5 * (sxx + syy) + root
        across = max(sxx + syy - along, 0.0)
        if along < 9 * across or along < 1e-6:
            continue  # a blob, not a wall
        wx, wy = (root + half, sxy) if half > 0 else (sxy, root - half)
        length = math.sqrt(wx * wx + wy * wy)
        nx, ny = -wy / length, wx / length
        if nx * points[i, 0] + ny * points[i, 1] > 0:
            nx, ny = -nx, -ny
        noise = max(across / (n - 2), least_variance)
        normals[beams[i], 0], normals[beams[i], 1] = nx, ny
        variances[beams[i], 0] = noise
        variances[beams[i], 1] = noise / along
    return bent + BEARING_RAD


def prepare_scan(
    points: NDArray[np.floating],
    angle_min: float,
    angle_increment: float,
    mount: Array = AT_ORIGIN,
    range_noise_m: float = RANGE_NOISE_M,
) -> Scan:
    """Fit the walls of a scan. `points` (B, 2) in the scanner's frame, NaN where there is no return."""
    placed: Array = np.ascontiguousarray(points, dtype=np.float64)
    normals, variances = np.empty_like(placed), np.empty_like(placed)
    bent_rad = _fit_walls(placed, angle_min, angle_increment, range_noise_m, normals, variances)
    return Scan(placed, normals, variances, angle_min, angle_increment, bent_rad, mount, range_noise_m)
