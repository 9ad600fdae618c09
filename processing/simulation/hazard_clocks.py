"""Hazards of the clocks: content that is older than its stamp, stamps that jitter, messages that do not come.

In: what strikes a run; the stamps of its samples. Out: delays, other stamps, which ticks have a message.
"""

import numpy as np
from numpy.typing import NDArray

from processing.simulation.hazards import Jitter, OdometryLate, ScansLate
from processing.simulation.lots import Strike

Array = NDArray[np.float64]


def delay_s(strikes: list[Strike], kind: type[OdometryLate] | type[ScansLate]) -> float:
    """By how much all that a sensor says is older than its stamp: the host stamps what arrives, and it arrives late."""
    return sum(strike.hazard.delay_s for strike in strikes if isinstance(strike.hazard, kind))


def jittered(strike: Strike, sweep_s: Array, latched_s: Array) -> tuple[Array, Array]:
    """The stamps (n,) of scans and of encoders; sorted, as messages are stamped in the order in which they come."""
    hazard = strike.hazard
    assert isinstance(hazard, Jitter)
    off = hazard.std_s * strike.generator.standard_normal((2, len(sweep_s)))
    scans = np.sort(sweep_s + off[0]) if hazard.of in ("scans", "both") else sweep_s
    odometry = np.sort(latched_s + off[1]) if hazard.of in ("odometry", "both") else latched_s
    return scans, odometry


def is_within(strike: Strike, time_s: Array) -> NDArray[np.bool_]:
    """At which of the times (n,) the hazard lasts."""
    spans = strike.spans_s(float(time_s[-1]))
    return np.any([(time_s > start_s) & (time_s <= end_s) for start_s, end_s in spans], axis=0)
