"""Scan matching: where the scanner stood, relative to where it stood for a reference scan; point to line.

In: two scans as points in their own scanner frames, and a first guess. Out: a `ScanMatch`: the motion, and a
covariance that tells the truth in a straight drift, where the motion along the drift cannot be seen.

    reference scan         o──o──o──o──o     a wall: its points, each with the normal of the line through its neighbours
    current scan, moved           ×          its point is drawn to that line, not to a point of it (Censi 2008)

Each point of the current scan is moved by the guess, finds the nearest reference point among the bearings around its
own, and pulls along that point's normal. Normals come from noisy points, so a perfectly smooth wall seems to hold a
little information about the motion along it, and that false information always says "you did not move". It is known
how large it is (the variance of each normal), so it is taken out again; what is then left without information keeps
the first guess and a large covariance (`UNSEEN_VARIANCE`).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from processing.scan_match import ScanMatch

Array = NDArray[np.float64]

RANGE_NOISE_M = 0.012  # statistical error of an LMS111, data sheet
WALL_LENGTH_M = 0.35  # a normal is fitted to at least this much wall, where there are enough points
MAX_NEIGHBOURS = 12
GRAZING = 6.0  # neighbouring points further apart than this many times r·Δφ see no wall, or see it at less than 10°
UNSEEN_VARIANCE = 1e4  # m², rad²: the match says nothing about this direction
CORRELATION = 2.0  # neighbouring beams share roughness and calibration errors: so many of them count as one
PRETENCE = 3.0  # information less than so many times what noisy normals pretend is none
MIN_MATCHED = 10  # points, and
MIN_OVERLAP = 0.08  # of the current scan's: fewer in common are no match
CLOSEST_M = 0.25  # pairs of points further apart than this are no pairs, once the guess has become good
LEVER_M = 5.0  # a typical distance to the walls
MODEL_NOISE_M = 0.002  # what matching on other points of a rough wall leaves, however many beams see it


@dataclass(frozen=True, slots=True)
class Scan:
    """A scan ready for matching, in its own frame: x ahead of the scanner, y left; B beams by ascending bearing."""

    points: Array  # (B, 2) m; without a return: NaN
    normals: Array  # (B, 2) towards the scanner; NaN where no wall could be fitted
    variances: Array  # (B, 2): of the point off its line [m²], of the normal's direction [rad²]
    angle_min: float
    angle_increment: float


Matcher = Callable[[Scan, Scan, Array], ScanMatch]  # reference, current, first guess (3,)


@njit(cache=True)
def _fit_walls(points: Array, increment: float, normals: Array, variances: Array) -> None:
    """A line through each point and as many neighbours as span WALL_LENGTH_M: its normal, and how sure both are."""
    count = points.shape[0]
    for i in range(count):
        normals[i, 0] = normals[i, 1] = np.nan
        variances[i, 0] = variances[i, 1] = np.nan
        if not math.isfinite(points[i, 0]):
            continue
        low = high = i
        grow_low = grow_high = True
        while (grow_low or grow_high) and high - low < 2 * MAX_NEIGHBOURS:
            if grow_low:
                grow_low = low > 0 and _joined(points, low - 1, low, increment) and i - low < MAX_NEIGHBOURS
                if grow_low:
                    low -= 1
            if grow_high:
                grow_high = (
                    high < count - 1 and _joined(points, high, high + 1, increment) and high - i < MAX_NEIGHBOURS
                )
                if grow_high:
                    high += 1
            length = math.hypot(points[high, 0] - points[low, 0], points[high, 1] - points[low, 1])
            if high - low >= 4 and length > WALL_LENGTH_M:
                break
        n = high - low + 1
        if n < 4 or i - low < 1 or high - i < 1:
            continue
        mx = my = 0.0
        for j in range(low, high + 1):
            mx += points[j, 0]
            my += points[j, 1]
        mx /= n
        my /= n
        sxx = sxy = syy = 0.0
        for j in range(low, high + 1):
            dx, dy = points[j, 0] - mx, points[j, 1] - my
            sxx += dx * dx
            sxy += dx * dy
            syy += dy * dy
        angle = 0.5 * math.atan2(2 * sxy, sxx - syy)  # of the wall
        c, s = math.cos(angle), math.sin(angle)
        along = c * c * sxx + 2 * c * s * sxy + s * s * syy
        across = max(sxx + syy - along, 0.0)
        if along < 9 * across or along < 1e-6:
            continue  # a blob, not a wall
        nx, ny = -s, c
        if nx * points[i, 0] + ny * points[i, 1] > 0:
            nx, ny = -nx, -ny
        noise = max(across / (n - 2), RANGE_NOISE_M * RANGE_NOISE_M)
        normals[i, 0], normals[i, 1] = nx, ny
        variances[i, 0] = noise
        variances[i, 1] = noise / along


@njit(cache=True, inline="always")
def _joined(points: Array, i: int, j: int, increment: float) -> bool:
    """Do two neighbouring beams see one wall?"""
    gap = math.hypot(points[j, 0] - points[i, 0], points[j, 1] - points[i, 1])
    reach = math.hypot(points[i, 0], points[i, 1])
    return gap < max(0.15, GRAZING * increment * reach)  # NaN compares false


def prepare_scan(points: Array, angle_min: float, angle_increment: float) -> Scan:
    """Fit the walls of a scan. `points` (B, 2) in the scanner's frame, NaN where there is no return."""
    points = np.ascontiguousarray(points, dtype=np.float64)
    normals, variances = np.empty_like(points), np.empty_like(points)
    _fit_walls(points, angle_increment, normals, variances)
    return Scan(points, normals, variances, angle_min, angle_increment)


@njit(cache=True)
def _gauss_newton(
    ref_points: Array,
    ref_normals: Array,
    ref_variances: Array,
    angle_min: float,
    increment: float,
    points: Array,
    normals: Array,
    guess: Array,
    reach_m: float,
    max_iterations: int,
    motion: Array,
    covariance: Array,
) -> tuple[int, int, int, float, bool]:
    """Fill motion (3,) and covariance (3, 3).

    Returns: points on walls, those that the reference must have seen, those that matched, their rms distance to the
    line [m], converged.
    """
    beams, count = ref_points.shape[0], points.shape[0]
    motion[:] = guess
    converged = False
    valid = visible = matched = 0
    sum_squares = 0.0
    gradient, step = np.zeros(3), np.zeros(3)
    information, false_information = np.zeros((3, 3)), np.zeros((3, 3))
    lever = np.array(
        [1.0, 1.0, 1.0 / LEVER_M]
    )  # makes a radian comparable to a metre, so that eigenvectors mean something
    scale = np.outer(lever, lever)
    for iteration in range(max_iterations):
        reach = max(reach_m * 0.6**iteration, CLOSEST_M)
        c, s = math.cos(motion[2]), math.sin(motion[2])
        information[:] = 0.0
        false_information[:] = 0.0
        gradient[:] = 0.0
        valid = visible = matched = 0
        sum_squares = sum_weights = 0.0
        for i in range(count):
            if not math.isfinite(normals[i, 0]):
                continue
            valid += 1
            px, py = points[i, 0], points[i, 1]
            rx, ry = c * px - s * py, s * px + c * py
            x, y = rx + motion[0], ry + motion[1]
            nx, ny = c * normals[i, 0] - s * normals[i, 1], s * normals[i, 0] + c * normals[i, 1]
            distance = math.hypot(x, y)
            bearing = math.atan2(y, x) - angle_min
            if bearing < 0:
                bearing += 2 * math.pi
            middle = int(bearing / increment + 0.5)
            width = beams if distance <= reach else int(math.asin(reach / distance) / increment) + 1
            best, best_square = -1, reach * reach
            for j in range(max(0, middle - width), min(beams, middle + width + 1)):
                dx, dy = x - ref_points[j, 0], y - ref_points[j, 1]
                square = dx * dx + dy * dy
                if square < best_square and nx * ref_normals[j, 0] + ny * ref_normals[j, 1] > 0.7:
                    best, best_square = j, square
            if best < 0:  # gone, or never in the reference's sight: beside its field of view, or behind its walls?
                if (
                    middle < beams
                    and not distance > math.hypot(ref_points[middle, 0], ref_points[middle, 1]) + CLOSEST_M
                ):
                    visible += 1
                continue
            visible += 1
            mx, my = ref_normals[best, 0], ref_normals[best, 1]
            error = mx * (x - ref_points[best, 0]) + my * (y - ref_points[best, 1])
            variance = ref_variances[best, 0] + RANGE_NOISE_M * RANGE_NOISE_M
            corner = 9.0 * variance + ((reach - CLOSEST_M) / 3.0) ** 2  # wide at first: a poor guess is no outlier
            weight = 1.0 / (variance * (1.0 + error * error / corner) ** 2)  # Geman-McClure
            turn = -mx * ry + my * rx  # ∂error/∂θ
            matched += 1
            sum_squares += weight * error * error
            sum_weights += weight
            row = (mx, my, turn)
            for a in range(3):
                gradient[a] += weight * row[a] * error
                for b in range(3):
                    information[a, b] += weight * row[a] * row[b]
            tx, ty = -my, mx
            lie = (tx, ty, -tx * ry + ty * rx)
            for a in range(3):
                for b in range(3):
                    false_information[a, b] += weight * ref_variances[best, 1] * lie[a] * lie[b]
        if matched < max(MIN_MATCHED, MIN_OVERLAP * valid):
            break
        # Directions whose information is mostly pretence are left as the guess has them (Zhang 2016, solution
        # remapping).
        values, vectors = np.linalg.eigh(information * scale)
        step[:] = 0.0
        covariance[:] = 0.0
        for k in range(3):
            v = vectors[:, k]
            false = 0.0
            pull = 0.0
            for a in range(3):
                pull += v[a] * gradient[a] * lever[a]
                for b in range(3):
                    false += v[a] * v[b] * false_information[a, b] * scale[a, b]
            seen = values[k] > PRETENCE * false and values[k] > 1e-3
            variance = CORRELATION / (values[k] - false) + MODEL_NOISE_M * MODEL_NOISE_M if seen else UNSEEN_VARIANCE
            for a in range(3):
                if seen:
                    step[a] += v[a] * lever[a] * pull / values[k]
                for b in range(3):
                    covariance[a, b] += variance * v[a] * v[b] * scale[a, b]
        motion -= step
        moved = math.hypot(step[0], step[1])
        if reach <= CLOSEST_M and moved < 2e-4 and abs(step[2]) < 2e-5:
            converged = True
            break
        if iteration == max_iterations - 1:  # points that change their partners for ever, by less than it matters
            converged = moved < 2e-3 and abs(step[2]) < 5e-4
    motion[2] = math.atan2(math.sin(motion[2]), math.cos(motion[2]))
    rms = math.sqrt(sum_squares / sum_weights) if matched else math.inf
    return valid, visible, matched, rms, converged


def match_scans(
    reference: Scan, current: Scan, guess: Array, reach_m: float = 1.0, max_iterations: int = 15
) -> ScanMatch:
    """The pose of `current` in the frame of `reference`, from the first guess (3,); scanner frames throughout.

    `reach_m`: how far off the guess may be; points that find no reference point within it do not count.
    """
    motion, covariance = np.empty(3), np.empty((3, 3))
    valid, visible, matched, rms, converged = _gauss_newton(
        reference.points,
        reference.normals,
        reference.variances,
        reference.angle_min,
        reference.angle_increment,
        current.points,
        current.normals,
        np.asarray(guess, dtype=np.float64),
        reach_m,
        max_iterations,
        motion,
        covariance,
    )
    if not converged:
        motion, covariance = np.array(guess, dtype=np.float64), np.eye(3) * UNSEEN_VARIANCE
    return ScanMatch(motion, covariance, matched / max(visible, 1), rms, converged, matched / max(valid, 1))
