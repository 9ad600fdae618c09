"""Hazards of a run's samples, one after the other: each changes what it names, and leaves the rest as it is.

In: what was sampled, what strikes the run. Out: what is recorded of it.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hw_profiles.profile import Profile
from processing.simulation.drive import Drive
from processing.simulation.hazard_beams import disturb_beams
from processing.simulation.hazard_clocks import is_within, jittered
from processing.simulation.hazard_tags import with_strays
from processing.simulation.hazard_vehicle import miscount
from processing.simulation.hazards import (
    Dropouts,
    Dust,
    FarReads,
    Jitter,
    OdometryMissing,
    OwnParts,
    ScansMissing,
    ThroughRock,
    WheelHazard,
)
from processing.simulation.lots import Strike
from processing.simulation.raycast import SegmentGrid
from processing.simulation.recording import Samples
from processing.simulation.world import Tag

Array = NDArray[np.float64]


def disturb(
    samples: Samples,
    strikes: list[Strike],
    drive: Drive,
    grid: SegmentGrid,
    vehicle: Profile,
    tags: list[Tag],
    places: Array,
) -> Samples:
    """The samples of a drive past walls and tags (at `places`, (m, 2)) by the true vehicle."""
    sweep_s, latched_s = samples.sweep_s, samples.latched_s  # without jitter: when it happens
    for strike in strikes:
        hazard = strike.hazard
        if isinstance(hazard, WheelHazard):
            samples = replace(samples, positions=miscount(strike, samples.positions, latched_s, vehicle))
        elif isinstance(hazard, Dropouts | Dust | OwnParts):
            samples = replace(samples, ranges=disturb_beams(strike, samples.ranges, sweep_s, samples.scanner))
        elif isinstance(hazard, ScansMissing):
            samples = replace(samples, has_scan=samples.has_scan & ~is_within(strike, sweep_s))
        elif isinstance(hazard, OdometryMissing):
            samples = replace(samples, has_joints=samples.has_joints & ~is_within(strike, latched_s))
        elif isinstance(hazard, FarReads | ThroughRock):
            position = drive.poses_at(samples.round_s)[:, :2]
            found = with_strays(samples.readings, strike, grid, tags, places, samples.round_s, position)
            samples = replace(samples, readings=found)
        elif isinstance(hazard, Jitter):
            scans_s, odometry_s = jittered(strike, samples.sweep_s, samples.latched_s)
            samples = replace(samples, sweep_s=scans_s, latched_s=odometry_s)
    return samples
