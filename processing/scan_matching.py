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
    bent_rad: float  # how far off its beam's bearing a point lies at most: the motion during the sweep was removed


Matcher = Callable[[Scan, Scan, Array], ScanMatch]  # reference, current, first guess (3,)


@njit(cache=True)
def _fit_walls(points: Array, angle_min: float, increment: float, normals: Array, variances: Array) -> float:
    """A line through each point and as many neighbours as span WALL_LENGTH_M: its normal, and how sure both are.

    Returns: how far off its beam's bearing a point lies at most [rad].
    """
    count, bent = points.shape[0], 0.0
    for i in range(count):
        if math.isfinite(points[i, 0]):
            off = math.atan2(points[i, 1], points[i, 0]) - (angle_min + i * increment)
            bent = max(bent, abs(off - 2 * math.pi * round(off / (2 * math.pi))))
    joined = np.zeros(count, np.bool_)  # with the next beam: do the two see one wall?
    for i in range(count - 1):
        dx, dy = points[i + 1, 0] - points[i, 0], points[i + 1, 1] - points[i, 1]
        reach = math.sqrt(points[i, 0] * points[i, 0] + points[i, 1] * points[i, 1])
        joined[i] = math.sqrt(dx * dx + dy * dy) < max(0.15, GRAZING * increment * reach)  # NaN compares false
    for i in range(count):
        normals[i, 0] = normals[i, 1] = np.nan
        variances[i, 0] = variances[i, 1] = np.nan
        if i == 0 or i == count - 1 or not (joined[i - 1] and joined[i]):
            continue
        # Grow to both sides, a beam at a time; the moments are those about point i.
        x0, y0 = points[i, 0], points[i, 1]
        low = high = i
        grow_low = grow_high = True
        sx = sy = sxx = sxy = syy = 0.0
        while (grow_low or grow_high) and high - low < 2 * MAX_NEIGHBOURS:
            if grow_low:
                grow_low = low > 0 and joined[low - 1] and i - low < MAX_NEIGHBOURS
                if grow_low:
                    low -= 1
                    dx, dy = points[low, 0] - x0, points[low, 1] - y0
                    sx, sy, sxx, sxy, syy = sx + dx, sy + dy, sxx + dx * dx, sxy + dx * dy, syy + dy * dy
            if grow_high:
                grow_high = high < count - 1 and joined[high] and high - i < MAX_NEIGHBOURS
                if grow_high:
                    high += 1
                    dx, dy = points[high, 0] - x0, points[high, 1] - y0
                    sx, sy, sxx, sxy, syy = sx + dx, sy + dy, sxx + dx * dx, sxy + dx * dy, syy + dy * dy
            if high - low >= 4:
                dx, dy = points[high, 0] - points[low, 0], points[high, 1] - points[low, 1]
                if dx * dx + dy * dy > WALL_LENGTH_M * WALL_LENGTH_M:
                    break
        n = high - low + 1
        if n < 4:
            continue
        sxx, sxy, syy = sxx - sx * sx / n, sxy - sx * sy / n, syy - sy * sy / n
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
        if nx * x0 + ny * y0 > 0:
            nx, ny = -nx, -ny
        noise = max(across / (n - 2), RANGE_NOISE_M * RANGE_NOISE_M)
        normals[i, 0], normals[i, 1] = nx, ny
        variances[i, 0] = noise
        variances[i, 1] = noise / along
    return bent


def prepare_scan(points: Array, angle_min: float, angle_increment: float) -> Scan:
    """Fit the walls of a scan. `points` (B, 2) in the scanner's frame, NaN where there is no return."""
    points = np.ascontiguousarray(points, dtype=np.float64)
    normals, variances = np.empty_like(points), np.empty_like(points)
    bent_rad = _fit_walls(points, angle_min, angle_increment, normals, variances)
    return Scan(points, normals, variances, angle_min, angle_increment, bent_rad)


@njit(cache=True)
def _nearest(
    points: Array,
    normals: Array,
    increment: float,
    bent: float,
    middle: int,
    at: tuple[float, float, float, float, float],
    reach: float,
) -> int:
    """The point of the reference (B, 2) nearest to one `at` x, y with normal nx, ny and range r, among those within
    reach whose normals face alike; -1: none.

    From the bearing of the point outwards: a point seen x rad off lies no nearer than r sin(x) (Censi 2008, section V).
    """
    x, y, nx, ny, r = at
    beams = points.shape[0]
    best, best_square = -1, reach * reach
    for k in range(max(0, middle - beams + 1), max(middle + 1, beams - middle)):
        off = min(max((k - 0.5) * increment - bent, 0.0), math.sqrt(2.0))
        closest = r * (off - off * off * off / 6)  # below r sin(x)
        if closest * closest >= best_square:
            break
        for j in (middle - k, middle + k):
            if 0 <= j < beams:
                dx, dy = x - points[j, 0], y - points[j, 1]
                square = dx * dx + dy * dy
                if square < best_square and nx * normals[j, 0] + ny * normals[j, 1] > 0.7:
                    best, best_square = j, square
    return best


@njit(cache=True)
def _eigen(matrix: Array, values: Array, vectors: Array) -> None:
    """Eigenvalues (3,) and eigenvectors (3, 3), columns, of a symmetric matrix (3, 3), by Jacobi's rotations."""
    a = matrix.copy()
    vectors[:] = np.eye(3)
    for _ in range(30):
        if abs(a[0, 1]) + abs(a[0, 2]) + abs(a[1, 2]) <= 1e-15 * (abs(a[0, 0]) + abs(a[1, 1]) + abs(a[2, 2])):
            break
        for p, q in ((0, 1), (0, 2), (1, 2)):
            if a[p, q] == 0.0:
                continue
            theta = (a[q, q] - a[p, p]) / (2 * a[p, q])
            t = math.copysign(1.0, theta) / (abs(theta) + math.sqrt(theta * theta + 1))
            c = 1 / math.sqrt(t * t + 1)
            s = t * c
            for k in range(3):
                a[k, p], a[k, q] = c * a[k, p] - s * a[k, q], s * a[k, p] + c * a[k, q]
            for k in range(3):
                a[p, k], a[q, k] = c * a[p, k] - s * a[q, k], s * a[p, k] + c * a[q, k]
            for k in range(3):
                vectors[k, p], vectors[k, q] = (
                    c * vectors[k, p] - s * vectors[k, q],
                    s * vectors[k, p] + c * vectors[k, q],
                )
    for k in range(3):
        values[k] = a[k, k]


@njit(cache=True)
def _gauss_newton(
    ref_points: Array,
    ref_normals: Array,
    ref_variances: Array,
    angle_min: float,
    increment: float,
    bent: float,
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
    beams = ref_points.shape[0]
    on_walls = np.flatnonzero(np.isfinite(normals[:, 0]))
    motion[:] = guess
    converged = False
    valid, visible, matched = len(on_walls), 0, 0
    sum_squares = sum_weights = 0.0
    step, values, vectors = np.zeros(3), np.zeros(3), np.zeros((3, 3))
    lever = np.array(
        [1.0, 1.0, 1.0 / LEVER_M]
    )  # makes a radian comparable to a metre, so that eigenvectors mean something
    scale = np.outer(lever, lever)
    for iteration in range(max_iterations):
        reach = max(reach_m * 0.6**iteration, CLOSEST_M)
        c, s = math.cos(motion[2]), math.sin(motion[2])
        visible = matched = 0
        g0 = g1 = g2 = i00 = i01 = i02 = i11 = i12 = i22 = f00 = f01 = f02 = f11 = f12 = f22 = 0.0
        sum_squares = sum_weights = 0.0
        for i in on_walls:
            px, py = points[i, 0], points[i, 1]
            rx, ry = c * px - s * py, s * px + c * py
            x, y = rx + motion[0], ry + motion[1]
            nx, ny = c * normals[i, 0] - s * normals[i, 1], s * normals[i, 0] + c * normals[i, 1]
            distance = math.sqrt(x * x + y * y)
            bearing = math.atan2(y, x) - angle_min
            if bearing < 0:
                bearing += 2 * math.pi
            middle = int(bearing / increment + 0.5)
            best = _nearest(ref_points, ref_normals, increment, bent, middle, (x, y, nx, ny, distance), reach)
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
            matched += 1
            sum_squares += weight * error * error
            sum_weights += weight
            turn = -mx * ry + my * rx  # ∂error/∂θ; of a motion along the wall, its square
            slide = my * ry + mx * rx
            g0, g1, g2 = g0 + weight * mx * error, g1 + weight * my * error, g2 + weight * turn * error
            i00, i01, i02 = i00 + weight * mx * mx, i01 + weight * mx * my, i02 + weight * mx * turn
            i11, i12, i22 = i11 + weight * my * my, i12 + weight * my * turn, i22 + weight * turn * turn
            doubt = weight * ref_variances[best, 1]
            f00, f01, f02 = f00 + doubt * my * my, f01 - doubt * my * mx, f02 - doubt * my * slide
            f11, f12, f22 = f11 + doubt * mx * mx, f12 + doubt * mx * slide, f22 + doubt * slide * slide
        if matched < max(MIN_MATCHED, MIN_OVERLAP * valid):
            break
        gradient = np.array([g0, g1, g2])
        information = np.array([[i00, i01, i02], [i01, i11, i12], [i02, i12, i22]])
        false_information = np.array([[f00, f01, f02], [f01, f11, f12], [f02, f12, f22]])
        # Directions whose information is mostly pretence are left as the guess has them (Zhang 2016, solution
        # remapping).
        _eigen(information * scale, values, vectors)
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
        reference.bent_rad,
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
