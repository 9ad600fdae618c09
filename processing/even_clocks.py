"""Even clocks: stamps that scatter about an even pace, put back onto it.

In: a run whose scans and odometry were taken at an even pace, but stamped by a host that was now and then busy. Out:
the same run with even times, or nothing where the pace is none. What the stamps said is kept, for poses go by it.
"""

from dataclasses import replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.ndimage import median_filter
from scipy.optimize import isotonic_regression

from processing.read_log import Run

Array = NDArray[np.float64]

LEAST_S, MOST = 0.003, 0.4  # less scatter does no harm; more, as a share of the pace, leaves no pace to be seen
SLOW = 101  # samples over which a clock may run fast or slow
FIRST = 32  # samples from which the pace is first told


def with_even_clocks(run: Run) -> Run | None:
    scans, motions = even_times(run.scans.times), even_times(run.motion_times)
    if scans is None and motions is None:
        return None
    stamped = run.scans.times, run.motion_times
    times = stamped[0] if scans is None else scans
    motion_times = stamped[1] if motions is None else motions
    return replace(run, scans=replace(run.scans, times=times), motion_times=motion_times, stamped=stamped)


def even_times(times: Array) -> Array | None:
    """Times (n,) on an even pace, of which samples may be missing; None where they keep it already, or keep none."""
    count = len(times)
    if count < 2 * FIRST:
        return None
    widest = sliding_window_view(np.diff(times), FIRST - 1).max(axis=1)
    first = int(np.argmin(widest))  # where most likely no sample is missing
    last = first + FIRST
    pace, start = (float(of) for of in np.polyfit(np.arange(FIRST), times[first:last], 1))
    while last - first < count:  # the longer the stretch, the better its pace is known, and the further it carries
        grown = (last - first) // 2
        first, last = max(0, first - grown), min(count, last + grown)
        number = _beats(times[first:last], start, pace)
        pace, start = (float(of) for of in np.polyfit(number, times[first:last], 1))
    number = _beats(times, start, pace)
    off = times - start - pace * number
    slow = median_filter(off, SLOW, mode="nearest")
    scatter = float(np.std(off - slow))
    if not LEAST_S < scatter < MOST * pace:
        return None
    even = start + pace * number + slow
    return np.asarray(np.maximum.accumulate(even - 1e-9 * np.arange(count)) + 1e-9 * np.arange(count), np.float64)


def _beats(times: Array, start: float, pace: float) -> Array:
    """The number (n,) of the beat of each sample: they rise, though scatter may have carried two to one beat."""
    rank = np.arange(len(times))
    ahead = isotonic_regression((times - start) / pace - rank).x
    return np.asarray(np.round(ahead) + rank, np.float64)
