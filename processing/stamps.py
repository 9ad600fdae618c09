"""Stamps that jitter or run backwards → times that rise, in the order of the recording, because that order is true.

In: header stamps as they were recorded [ns]. Out: stamps that rise strictly.
"""

from bisect import bisect_left

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]


def rising_stamps(stamps_ns: Stamps) -> Stamps:
    """Stamps (n,) that rise strictly, in the order of the recording.

    The longest rising run among the stamps is taken at its word; the others are spread evenly over the gaps in it that
    they were recorded in, or go on at the usual pace before its first and after its last.
    """
    believed, index = _longest_rising(stamps_ns), np.arange(len(stamps_ns))
    first, last = believed[0], believed[-1]
    since = stamps_ns[believed] - stamps_ns[first]
    spread = np.interp(index, believed, since)
    pace = np.median(np.diff(since) / np.diff(believed)) if len(believed) > 1 else 0.0
    spread += pace * (np.minimum(index - first, 0) + np.maximum(index - last, 0))
    rising = np.maximum.accumulate(np.round(spread).astype(np.int64) - index) + index
    return np.asarray(stamps_ns[first] + rising, np.int64)


def _longest_rising(stamps_ns: Stamps) -> NDArray[np.int64]:
    """Indices of the longest strictly rising run, which may leave stamps out (Schensted 1961).

    Taken from the last stamp to the first, so that of two that contradict each other the earlier is believed.
    """
    if np.all(np.diff(stamps_ns) > 0):  # as nearly always
        return np.arange(len(stamps_ns))
    firsts: list[int] = []  # negated: the highest stamp that a run of each length can begin with
    starts: list[int] = []  # and its index
    after = [-1] * len(stamps_ns)
    for k in range(len(stamps_ns) - 1, -1, -1):
        negated = -int(stamps_ns[k])
        length = bisect_left(firsts, negated)
        after[k] = starts[length - 1] if length else -1
        firsts[length : length + 1], starts[length : length + 1] = [negated], [k]
    run = [starts[-1]]
    while after[run[-1]] >= 0:
        run.append(after[run[-1]])
    return np.array(run, np.int64)


def take_over_times(scan_ns: Stamps, scan_times: Array, motion_ns: Stamps, motion_times: Array) -> None:
    """A scan with the very stamp of an odometry message belongs to that message, whatever backward stamps did to
    either.
    """
    order = np.argsort(motion_ns, kind="stable")
    at = np.minimum(np.searchsorted(motion_ns[order], scan_ns), len(order) - 1)
    same = motion_ns[order[at]] == scan_ns
    scan_times[same] = motion_times[order[at[same]]]
    steps = np.arange(len(scan_ns)) * 1e-9
    scan_times[:] = np.maximum.accumulate(scan_times - steps) + steps
