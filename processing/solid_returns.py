"""Which returns of a scan are of something solid: grains of dust and drops of water hang alone before the walls.

    wall      ──●──────●──●─────────●──●──      what stands out towards the scanner from all that is beside it, and is
                   ×         ×   ×              no wider than three beams, is left out; then what hid behind it, until
    dust             ×         ×                nothing stands out any more: so a wall that is seen here and there
                     scanner                    between the grains stays whole

In: points in the scanner's frame, by ascending bearing. Out: the beams to which walls may be fitted. What is so narrow
makes no wall anyway: it only cuts the wall behind it in two, or bends it.
"""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

THIN_BEAMS = 3
STANDS_OUT_M = 0.3  # in clear air, where rough rock stands out as well
DUSTY = 0.02  # where more than this share of the returns stands out, there is dust …
DUST_STANDS_OUT = 5.0  # … and what stands out by so many standard deviations is more likely dust than rock


@njit(cache=True, error_model="numpy")
def solid_returns(points: Array, range_noise_m: float) -> Ints:
    """The beams, ascending, whose points (B, 2) are of something solid; NaN is no return."""
    beams, count = _peel(points, STANDS_OUT_M)
    if len(beams) < (1 - DUSTY) * count:
        beams, count = _peel(points, DUST_STANDS_OUT * range_noise_m)
    return beams


@njit(cache=True, error_model="numpy")
def _peel(points: Array, least_m: float) -> tuple[Ints, int]:
    """The beams that are left, and how many had a return. Beside the first and the last lies nothing, far away."""
    kept, ranges = np.empty(points.shape[0], np.int64), np.empty(points.shape[0])
    left = count = 0
    for i in range(points.shape[0] + 1):
        reach = math.inf
        if i < points.shape[0]:
            reach = math.sqrt(points[i, 0] * points[i, 0] + points[i, 1] * points[i, 1])
            if not math.isfinite(reach):
                continue
            count += 1
        first = left  # those kept from here on stand out from this return; do they from the one before them, too?
        while first > 0 and left - first < THIN_BEAMS and ranges[first - 1] + least_m < reach:
            first -= 1
            if first == 0 or ranges[first] + least_m < ranges[first - 1]:
                left = first
        if i < points.shape[0]:
            kept[left], ranges[left] = i, reach
            left += 1
    return kept[:left], count
