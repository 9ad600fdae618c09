"""Polar scan matching: how the laser moved between two scans, found beam by beam at the same bearing.

In: ranges of a reference and a current scan at the same even bearings, a first guess. Out: a `ScanMatch`.

    project      the current scan is seen from the reference laser, through the present guess: each stretch between
                 two neighbours on one surface is cut by the reference's bearings; nearer surfaces hide farther ones,
                 and one seen from its back hides without being matched
    orientation  the projected ranges are shifted by whole beams; a parabola through the best three gives the rest
    translation  weighted least squares on the differences d of the ranges at each bearing, w = c^m / (d^m + c^m), m = 2

alternated, with c shrinking, until neither moves the guess.

Source: Diosi & Kleeman 2005, 2007 (IJRR 26:1125). Two things are ours. A difference of range is turned into one along
the normal of the reference's wall; the paper takes the bearing itself, which along a drift is four times less accurate.
And the covariance is that of the normal equations, so that what the walls leave open is said to be open.
"""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from processing.polar_scan import MEDIAN_BEAMS, filter_ranges, fit_normals, label_surfaces
from processing.scan_match import ScanMatch

Array = NDArray[np.float64]

MAX_ROUNDS = 25  # of projection, orientation, projection, translation
SETTLED_M, SETTLED_RAD, CYCLE = 2e-4, 2e-4, 10.0
MAX_DIFFERENCE_M = 1.0  # ranges further apart are of different things
COARSE_M, FINE_M = 0.7, 0.1  # the weight's c, in the first round and in the last ones
SEARCH_RAD = math.radians(20)  # the first orientation search to either side; later ones halve it
MIN_OVERLAP = 0.1  # of the beams: with fewer in common there is no match
BEHIND_M = 0.25  # what lies farther than this behind the reference's wall was hidden from it
RANGE_NOISE_M = 0.01  # no residual makes a match surer than the laser is
UNSEEN_M = 10.0  # standard deviation of a motion that the walls say nothing of


def match_polar(reference_ranges: Array, current_ranges: Array, angles: Array, initial_guess: Array) -> ScanMatch:
    """Match two scans.

    Args:
        reference_ranges: (B,) [m]; +inf, NaN and numbers not above 0 are beams without a wall.
        current_ranges: (B,) likewise. Cut both at the range that the laser is good for.
        angles: (B,) [rad] even, ascending, counter-clockwise; a field of view of less than a full turn.
        initial_guess: (3,) pose of the current laser in the frame of the reference laser; also the result, with a
            covariance that says nothing, where no match is found.
    """
    increment = (angles[-1] - angles[0]) / (len(angles) - 1)
    reference, current = filter_ranges(reference_ranges), filter_ranges(current_ranges)
    labels, current_labels = label_surfaces(reference, increment), label_surfaces(current, increment)
    cosines, sines = np.cos(angles), np.sin(angles)
    normals = fit_normals(reference, labels, cosines, sines, increment)
    pose, converged = _alternate(
        reference, labels, normals, current, current_labels, cosines, sines, increment, np.array(initial_guess, float)
    )
    projected = _project(current, current_labels, cosines, sines, increment, pose)
    information, residual, inliers, visible = _normal_equations(
        reference, labels, normals, projected, cosines, sines, pose
    )
    share, overlap = inliers / max(1, visible), inliers / max(1, int(np.count_nonzero(current_labels)))
    if not converged or inliers < MIN_OVERLAP * len(angles):
        return ScanMatch(np.array(initial_guess, float), UNSEEN_M**2 * np.eye(3), share, residual, False, overlap)
    return ScanMatch(pose, _covariance(information, residual), share, residual, True, overlap)


@njit(cache=True)
def _alternate(
    reference: Array,  # (B,) filtered
    labels: NDArray[np.int64],  # (B,)
    normals: Array,  # (B, 3)
    current: Array,  # (B,)
    current_labels: NDArray[np.int64],  # (B,)
    cosines: Array,  # (B,) of the bearings
    sines: Array,  # (B,)
    increment: float,
    pose: Array,  # (3,) the first guess; becomes the result
) -> tuple[Array, bool]:
    reach, scale, settled, restless = int(SEARCH_RAD / increment), COARSE_M, 0, np.inf
    for _ in range(MAX_ROUNDS):
        projected = _project(current, current_labels, cosines, sines, increment, pose)
        turn = _search_orientation(reference, labels, projected, reach, scale) * increment
        pose[2] += turn
        projected = _project(current, current_labels, cosines, sines, increment, pose)
        dx, dy, moved = _estimate_translation(reference, labels, normals, projected, cosines, sines, scale)
        pose[0] += dx
        pose[1] += dy
        restless = max(abs(turn) / SETTLED_RAD, moved / SETTLED_M)
        settled = settled + 1 if scale == FINE_M and restless < 1 else 0
        if settled == 2:
            break
        reach, scale = max(3, reach // 2), max(FINE_M, scale / 1.5)
    pose[2] = math.atan2(math.sin(pose[2]), math.cos(pose[2]))
    return pose, restless < CYCLE  # few beams: a pair of guesses may swap for ever, by less than it matters


@njit(cache=True)
def _project(
    ranges: Array, labels: NDArray[np.int64], cosines: Array, sines: Array, increment: float, pose: Array
) -> Array:
    """Ranges (B,) at which a laser at the origin would see this scan, taken at `pose`; 0 where it would see nothing."""
    n = len(ranges)
    projected, hidden = np.full(n, np.inf), np.zeros(n, np.bool_)
    c, s = math.cos(pose[2]), math.sin(pose[2])
    middle = (n - 1) / 2  # bearings are counted from the middle of the field of view: the cut lies behind the laser
    ahead_x, ahead_y = cosines[(n - 1) // 2] + cosines[n // 2], sines[(n - 1) // 2] + sines[n // 2]
    px, py, p_beam, p_label = 0.0, 0.0, 0.0, 0
    for i in range(n):
        if labels[i] > 0:
            x, y = ranges[i] * cosines[i], ranges[i] * sines[i]
            qx, qy = pose[0] + c * x - s * y, pose[1] + s * x + c * y
            bearing = math.atan2(ahead_x * qy - ahead_y * qx, ahead_x * qx + ahead_y * qy)
            q_beam = bearing / increment + middle
            if p_label == labels[i] and abs(q_beam - p_beam) * increment < math.pi:
                low, high = min(p_beam, q_beam), max(p_beam, q_beam)
                for k in range(max(0, math.ceil(low - 1e-9)), min(n - 1, math.floor(high + 1e-9)) + 1):
                    along = cosines[k] * (qy - py) - sines[k] * (qx - px)
                    area = px * qy - py * qx
                    if along * area > 0 and area / along < projected[k]:  # where bearing k cuts the line from p to q
                        projected[k], hidden[k] = area / along, q_beam < p_beam
            px, py, p_beam = qx, qy, q_beam
        p_label = labels[i]
    for k in range(n):
        if hidden[k] or projected[k] == np.inf:
            projected[k] = 0.0
    return projected


@njit(cache=True)
def _search_orientation(
    reference: Array, labels: NDArray[np.int64], projected: Array, reach: int, scale: float
) -> float:
    """By how many beams the projected scan must turn, counter-clockwise, to lie on the reference best."""
    n = len(reference)
    costs = np.full(2 * reach + 1, np.inf)
    for shift in range(-reach, reach + 1):
        cost, count = 0.0, 0
        for k in range(max(0, shift), min(n, n + shift)):
            if labels[k] > 0 and projected[k - shift] > 0:
                squared = (reference[k] - projected[k - shift]) ** 2
                cost += squared / (squared + scale * scale)  # bounded, so that what is hidden from one does not decide
                count += 1
        if count >= MIN_OVERLAP * n:
            costs[shift + reach] = cost / count
    best = int(np.argmin(costs))
    if 0 < best < 2 * reach:
        before, least, after = costs[best - 1], costs[best], costs[best + 1]
        if before + after < np.inf and before - 2 * least + after > 0:
            return best - reach + 0.5 * (before - after) / (before - 2 * least + after)
    return float(best - reach) if costs[best] < np.inf else 0.0


@njit(cache=True)
def _estimate_translation(
    reference: Array,
    labels: NDArray[np.int64],
    normals: Array,
    projected: Array,
    cosines: Array,
    sines: Array,
    scale: float,
) -> tuple[float, float, float]:
    """The shift (x, y) of the projected scan that brings its ranges closest to the reference's at the same bearings.

    With it by how much the walls move along their normals: creeping along a smooth drift is no movement.
    """
    hxx, hxy, hyy, bx, by = 1e-9, 0.0, 1e-9, 0.0, 0.0
    for k in range(len(reference)):
        difference = reference[k] - projected[k]
        if labels[k] > 0 and projected[k] > 0 and abs(difference) < MAX_DIFFERENCE_M:
            weight = scale * scale / (difference * difference + scale * scale)
            nx, ny = normals[k, 0], normals[k, 1]
            distance = difference * (nx * cosines[k] + ny * sines[k])  # from the wall, along its normal
            hxx, hxy, hyy = hxx + weight * nx * nx, hxy + weight * nx * ny, hyy + weight * ny * ny
            bx, by = bx + weight * nx * distance, by + weight * ny * distance
    weights = hxx + hyy  # normals have unit length
    damping = 0.003 * weights  # along a smooth wall the guess stays, instead of following the noise
    determinant = (hxx + damping) * (hyy + damping) - hxy * hxy
    dx, dy = ((hyy + damping) * bx - hxy * by) / determinant, ((hxx + damping) * by - hxy * bx) / determinant
    return dx, dy, math.sqrt((hxx * dx * dx + 2 * hxy * dx * dy + hyy * dy * dy) / weights)


@njit(cache=True)
def _normal_equations(
    reference: Array,
    labels: NDArray[np.int64],
    normals: Array,
    projected: Array,
    cosines: Array,
    sines: Array,
    pose: Array,
) -> tuple[Array, float, int, int]:
    """Σ w J Jᵀ (3, 3) of x, y, θ for residuals of unit variance; their root mean square [m]; how many beams are inliers
    and how many should be, as nothing in the reference stands before them.

    Noisy normals would see features on a smooth wall: a normal that is off by ε adds ε² T Tᵀ, T along the wall. What is
    to be expected of that, by the residuals' own size, is taken off again.
    """
    squares, count, visible = 0.0, 0, 0
    for k in range(len(reference)):
        if labels[k] > 0 and projected[k] > 0:
            difference = reference[k] - projected[k]
            distance = difference * (normals[k, 0] * cosines[k] + normals[k, 1] * sines[k])
            if difference > -BEHIND_M or abs(distance) < FINE_M:
                visible += 1
            if abs(distance) < FINE_M:
                squares, count = squares + distance * distance, count + 1
    residual = math.sqrt(squares / max(count, 1))
    noise = MEDIAN_BEAMS * max(residual, RANGE_NOISE_M) ** 2
    information, row, false_row = np.zeros((3, 3)), np.empty(3), np.empty(3)
    for k in range(len(reference)):
        difference = reference[k] - projected[k]
        if labels[k] > 0 and projected[k] > 0 and abs(difference) < MAX_DIFFERENCE_M:
            weight = FINE_M * FINE_M / (difference * difference + FINE_M * FINE_M)
            nx, ny = normals[k, 0], normals[k, 1]
            rx, ry = reference[k] * cosines[k] - pose[0], reference[k] * sines[k] - pose[1]
            row[0], row[1], row[2] = nx, ny, ny * rx - nx * ry
            false_row[0], false_row[1], false_row[2] = -ny, nx, nx * rx + ny * ry
            doubt = noise * normals[k, 2]
            for a in range(3):
                for b in range(3):
                    information[a, b] += weight * (row[a] * row[b] - doubt * false_row[a] * false_row[b])
    return information, residual, count, visible


def _covariance(information: Array, residual: float) -> Array:
    """Covariance (3, 3), bounded by `UNSEEN_M` in every direction; a turn counts as metres at the arm of the walls."""
    # the beams of one median window share their noise: together they count as one
    information = information / (MEDIAN_BEAMS * max(residual, RANGE_NOISE_M) ** 2)
    seen = information[0, 0] + information[1, 1]
    arm = np.sqrt(max(information[2, 2] / seen, 0.01)) if seen > 0 else 1.0
    scale = np.array([1.0, 1.0, arm])
    values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    bounded = (vectors / np.maximum(values, UNSEEN_M**-2)) @ vectors.T
    return np.asarray(bounded / np.outer(scale, scale))
