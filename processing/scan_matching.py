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
from dataclasses import replace

import numpy as np
from numba import njit
from numpy.typing import NDArray

from processing.scan_match import ScanMatch
from processing.scan_walls import BEARING_RAD, FUSED, Scan, bearing

Array = NDArray[np.float64]

UNSEEN_VARIANCE = 1e4  # m², rad²: the match says nothing about this direction
PRETENCE = 3.0  # information less than so many times what noisy normals pretend is none
SETTLED = 0.05  # standard deviations: steps smaller than this do not matter
MOST_RESTLESS = 0.5  # where points change their partners for ever, steps smaller than this end it
MIN_MATCHED = 10  # points, and
MIN_OVERLAP = 0.08  # of the current scan's: fewer in common are no match
COARSE = 3  # while pairs may be further apart than the next, every third point says enough
CLOSEST_M = 0.25  # pairs of points further apart than this are no pairs, once the guess has become good
LEVER_M = 5.0  # a typical distance to the walls
MODEL_NOISE_M = 0.001  # what matching on other points of a rough wall leaves, however many beams see it


Matcher = Callable[[Scan, Scan, Array], ScanMatch]  # reference, current, first guess (3,)


@njit(cache=True, error_model="numpy", fastmath=FUSED)
def nearest_wall(
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


@njit(cache=True, error_model="numpy", fastmath=FUSED)
def _gauss_newton(
    ref_points: Array,
    ref_normals: Array,
    ref_variances: Array,
    angle_min: float,
    increment: float,
    bent: float,
    points: Array,
    normals: Array,
    range_noise_m: float,
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
    beams, bent = ref_points.shape[0], bent + BEARING_RAD
    on_walls = np.flatnonzero(np.isfinite(normals[:, 0]))
    motion[:] = guess
    converged = False
    valid, visible, matched = len(on_walls), 0, 0
    sum_squares = sum_weights = 0.0
    restless_before = math.inf
    step, values, vectors = np.zeros(3), np.zeros(3), np.zeros((3, 3))
    lever = np.array(
        [1.0, 1.0, 1.0 / LEVER_M]
    )  # makes a radian comparable to a metre, so that eigenvectors mean something
    scale = np.outer(lever, lever)
    for iteration in range(max_iterations):
        reach = max(reach_m * 0.6**iteration, CLOSEST_M)
        every = COARSE if reach > CLOSEST_M else 1
        c, s = math.cos(motion[2]), math.sin(motion[2])
        visible = matched = 0
        g0 = g1 = g2 = i00 = i01 = i02 = i11 = i12 = i22 = f00 = f01 = f02 = f11 = f12 = f22 = 0.0
        sum_squares = sum_weights = 0.0
        for i in on_walls[::every]:
            px, py = points[i, 0], points[i, 1]
            rx, ry = c * px - s * py, s * px + c * py
            x, y = rx + motion[0], ry + motion[1]
            nx, ny = c * normals[i, 0] - s * normals[i, 1], s * normals[i, 0] + c * normals[i, 1]
            distance = math.sqrt(x * x + y * y)
            seen_at = bearing(x, y) - angle_min
            if seen_at < 0:
                seen_at += 2 * math.pi
            middle = int(seen_at / increment + 0.5)
            best = nearest_wall(ref_points, ref_normals, increment, bent, middle, (x, y, nx, ny, distance), reach)
            if best < 0:  # gone, or never in the reference's sight: without a beam, a return, or behind walls?
                if middle < beams and distance <= math.hypot(ref_points[middle, 0], ref_points[middle, 1]) + CLOSEST_M:
                    visible += 1
                continue
            visible += 1
            mx, my = ref_normals[best, 0], ref_normals[best, 1]
            error = mx * (x - ref_points[best, 0]) + my * (y - ref_points[best, 1])
            variance = ref_variances[best, 0] + range_noise_m * range_noise_m
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
        if every * matched < max(MIN_MATCHED, MIN_OVERLAP * valid):
            break
        gradient = np.array([g0, g1, g2])
        information = np.array([[i00, i01, i02], [i01, i11, i12], [i02, i12, i22]])
        false_information = np.array([[f00, f01, f02], [f01, f11, f12], [f02, f12, f22]])
        # Directions whose information is mostly pretence are left as the guess has them (Zhang 2016, solution
        # remapping).
        _eigen(information * scale, values, vectors)
        step[:] = 0.0
        covariance[:] = 0.0
        restless = 0.0  # the largest step, in standard deviations
        for k in range(3):
            v = vectors[:, k]
            false = 0.0
            pull = 0.0
            for a in range(3):
                pull += v[a] * gradient[a] * lever[a]
                for b in range(3):
                    false += v[a] * v[b] * false_information[a, b] * scale[a, b]
            seen = values[k] > PRETENCE * false and values[k] > 1e-3
            variance = 1.0 / (values[k] - false) + MODEL_NOISE_M * MODEL_NOISE_M if seen else UNSEEN_VARIANCE
            if seen:
                restless = max(restless, abs(pull / values[k]) / math.sqrt(variance))
            for a in range(3):
                if seen:
                    step[a] += v[a] * lever[a] * pull / values[k]
                for b in range(3):
                    covariance[a, b] += variance * v[a] * v[b] * scale[a, b]
        motion -= step
        if reach > CLOSEST_M:
            continue
        grows_calmer = restless < restless_before and iteration < max_iterations - 1
        if restless < SETTLED or (restless < MOST_RESTLESS and not grows_calmer):
            converged = True
            break
        restless_before = restless
    motion[2] = math.atan2(math.sin(motion[2]), math.cos(motion[2]))
    rms = math.sqrt(sum_squares / sum_weights) if matched else math.inf
    return valid, visible, matched, rms, converged


def approach(reference: Scan, current: Scan, guess: Array, reach_m: float, iterations: int) -> ScanMatch:
    """Where a match has got to after so many steps, converged or not."""
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
        current.range_noise_m,
        np.asarray(guess, dtype=np.float64),
        reach_m,
        iterations,
        motion,
        covariance,
    )
    return ScanMatch(motion, covariance, matched / max(visible, 1), rms, converged, matched / max(valid, 1))


def match_scans(
    reference: Scan, current: Scan, guess: Array, reach_m: float = 1.0, max_iterations: int = 15
) -> ScanMatch:
    """The pose of `current` in the frame of `reference`, from the first guess (3,); scanner frames throughout.

    `reach_m`: how far off the guess may be; points that find no reference point within it do not count.
    """
    found = approach(reference, current, guess, reach_m, max_iterations)
    if found.converged:
        return found
    return replace(found, motion=np.array(guess, dtype=np.float64), covariance=np.eye(3) * UNSEEN_VARIANCE)
