"""What a range scan says before it is matched: which beams to trust, which belong to one surface, which way it faces.

In: ranges (B,) [m] of beams at even bearings; +inf is no return, NaN invalid (REP-117). Out: the same beams, smoothed
and cut into surfaces, with normals. A filtered range of 0 marks a beam that says nothing.

Source: Diosi & Kleeman 2007, "Fast laser scan matching using polar coordinates", §3.1; the normals are ours.
"""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]

MEDIAN_BEAMS = 5  # window of the median filter: chair legs, dust and mixed pixels up to two beams wide go
MAX_JUMP_M = 0.15  # ranges of neighbours that differ by more belong to two surfaces …
MAX_BEND_M = 0.05  # … unless three in a row lie on one line as closely as this
MIN_BEAMS = 3  # fewer in a row are no surface
NORMAL_BEAMS, NORMAL_M = 5, 0.2  # a normal is that of the line through as much on either side, whichever is more


def ranges_at(angles: Array, points: NDArray[np.floating]) -> Array:
    """Ranges (B,) at even bearings of a sweep whose points (B, 2) the vehicle's motion has moved off them.

    At 4 m/s the last beam's point lies centimetres off its bearing, by the same at every scan: taken for a range at
    that bearing it turns each match to one side. NaN where a bearing has no points close by on both sides.
    """
    valid = np.flatnonzero(np.isfinite(points[:, 0]))
    if len(valid) < 2:
        return np.full(len(angles), np.nan)
    x, y = points[valid].astype(np.float64).T
    turned = np.arctan2(y, x) - angles[valid]  # small, also where the bearing itself passes ±π
    bearings = angles[valid] + (turned + np.pi) % (2 * np.pi) - np.pi
    order = np.argsort(bearings, kind="stable")
    bearings, ranges, beams = bearings[order], np.hypot(x, y)[order], valid[order]
    right = np.searchsorted(bearings, angles).clip(1, len(bearings) - 1)
    left = right - 1
    share = (angles - bearings[left]) / np.maximum(bearings[right] - bearings[left], 1e-12)
    between = (share >= 0) & (share <= 1) & (np.abs(beams[right] - beams[left]) <= 2)
    # a wall is a sine in 1 / range; what comes to lie between two surfaces is of neither, and no surface by itself
    return np.where(between, 1 / (1 / ranges[left] + share * (1 / ranges[right] - 1 / ranges[left])), np.nan)


@njit(cache=True)
def filter_ranges(ranges: Array) -> Array:
    """Median over the valid beams of each window (B,); a beam that is invalid itself stays so."""
    n, half = len(ranges), MEDIAN_BEAMS // 2
    filtered, window = np.zeros(n), np.empty(MEDIAN_BEAMS)
    for i in range(n):
        if not 0.0 < ranges[i] < np.inf:
            continue
        count = 0
        for j in range(max(0, i - half), min(n, i + half + 1)):
            if 0.0 < ranges[j] < np.inf:
                k = count
                while k > 0 and window[k - 1] > ranges[j]:
                    window[k] = window[k - 1]
                    k -= 1
                window[k] = ranges[j]
                count += 1
        middle = count // 2
        if count % 2 == 0 and ranges[i] < window[middle]:  # of the two in the middle, the one on this beam's side
            middle -= 1
        filtered[i] = window[middle]
    return filtered


@njit(cache=True)
def label_surfaces(ranges: Array, increment: float) -> NDArray[np.int64]:
    """The number of the surface each beam hit (B,), counted from 1; 0 where there is none or it is too small.

    A wall seen at a grazing angle jumps from beam to beam, yet lies on a line. That is asked from both sides: a rule
    that only looks back along the sweep turns the matches of a long drive by tens of degrees to one side.
    """
    n = len(ranges)
    labels = np.zeros(n, np.int64)
    current, start = 0, 0
    for i in range(n + 1):
        joined = False
        if 0 < i < n and ranges[i] > 0 and ranges[i - 1] > 0:
            joined = abs(ranges[i] - ranges[i - 1]) <= MAX_JUMP_M
            if not joined:
                joined = _on_line(ranges, i - 2, i - 1, i, increment) or _on_line(ranges, i + 1, i, i - 1, increment)
        if not joined:
            if i - start < MIN_BEAMS:
                labels[start:i] = 0
            start = i
            current += 1
        if i < n and ranges[i] > 0:
            labels[i] = current
    return labels


@njit(cache=True)
def _on_line(ranges: Array, a: int, b: int, c: int, increment: float) -> bool:
    """Does beam c lie on the line through its neighbours b and a? The inverse ranges of a line obey a recurrence."""
    if a < 0 or a >= len(ranges) or ranges[a] == 0:
        return False
    inverse = 2 * math.cos(increment) / ranges[b] - 1 / ranges[a]
    return inverse > 0 and abs(1 / inverse - ranges[c]) <= MAX_BEND_M


@njit(cache=True)
def fit_normals(ranges: Array, labels: NDArray[np.int64], cosines: Array, sines: Array, increment: float) -> Array:
    """Normals of the surface at each beam (B, 3): x, y, pointing away from the scanner, and 1 / Σ s² [1/m²].

    s is how far along the line through its surroundings each neighbour lies: range noise of variance σ² turns the
    normal by a variance of σ² / Σ s².
    """
    n = len(ranges)
    normals = np.zeros((n, 3))
    for i in range(n):
        if labels[i] == 0:
            continue
        sx, sy, sxx, sxy, syy, count = 0.0, 0.0, 0.0, 0.0, 0.0, 0
        half = max(NORMAL_BEAMS, int(NORMAL_M / (ranges[i] * increment)))
        for j in range(max(0, i - half), min(n, i + half + 1)):
            if labels[j] == labels[i]:
                x, y = ranges[j] * cosines[j] - ranges[i] * cosines[i], ranges[j] * sines[j] - ranges[i] * sines[i]
                sx, sy, count = sx + x, sy + y, count + 1
                sxx, sxy, syy = sxx + x * x, sxy + x * y, syy + y * y
        sxx, sxy, syy = sxx - sx * sx / count, sxy - sx * sy / count, syy - sy * sy / count
        along = 0.5 * math.atan2(2 * sxy, sxx - syy)
        nx, ny = -math.sin(along), math.cos(along)
        if nx * cosines[i] + ny * sines[i] < 0:
            nx, ny = -nx, -ny
        spread = 0.5 * (sxx + syy) + math.hypot(0.5 * (sxx - syy), sxy)
        normals[i, 0], normals[i, 1], normals[i, 2] = nx, ny, 1 / max(spread, 1e-9)
    return normals
