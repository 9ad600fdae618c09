"""Hazards of the beams: no return, a return from dust, a return from the vehicle itself.

In: ranges as they would have been. Out: ranges as they were, in whole millimetres again.
"""

import numpy as np
from numpy.typing import NDArray

from hw_profiles.errors import BadInputError
from processing.simulation.hazard_clocks import is_within
from processing.simulation.hazards import Dropouts, Dust, OwnParts
from processing.simulation.lots import Strike
from processing.simulation.sensors import beam_angles
from processing.simulation.world import Scanner

Array = NDArray[np.float64]
Ranges = NDArray[np.float32]
NEAREST_DUST_M = 0.2
PLATE_WIDTH_DEG, PLATE_M, PLATE_NOISE_M = (15.0, 40.0), (0.4, 1.5), 0.004  # the first two by lot


def disturb_beams(strike: Strike, ranges: Ranges, time_s: Array, scanner: Scanner) -> Ranges:
    """Ranges (n, beams) of sweeps at `time_s` (n,). What is nearer hides what is behind it."""
    hazard, rng = strike.hazard, strike.generator
    if isinstance(hazard, OwnParts):
        return _nearer(ranges, _plate(strike, hazard, scanner) + rng.normal(0.0, PLATE_NOISE_M, ranges.shape))
    assert isinstance(hazard, Dropouts | Dust)
    struck = is_within(strike, time_s)[:, None] & (rng.random(ranges.shape) < hazard.share)
    if isinstance(hazard, Dropouts):
        return np.where(struck, np.float32(np.inf), ranges)
    return _nearer(ranges, np.where(struck, rng.uniform(NEAREST_DUST_M, hazard.reach_m, ranges.shape), np.inf))


def _nearer(ranges: Ranges, others_m: Array) -> Ranges:
    return np.minimum(ranges, (np.round(others_m * 1000) / 1000).astype(np.float32))


def _plate(strike: Strike, hazard: OwnParts, scanner: Scanner) -> Array:
    """The distance (beams,) to a flat plate that stands across the middle of its sector; +inf beside it."""
    rng, half_deg = strike.generator, scanner.field_of_view_deg / 2
    width_deg = rng.uniform(*PLATE_WIDTH_DEG)
    lot_deg = rng.uniform(-half_deg, half_deg - width_deg)
    from_deg = lot_deg if hazard.from_deg is None else hazard.from_deg
    to_deg = from_deg + width_deg if hazard.to_deg is None else hazard.to_deg
    if not 0.0 < to_deg - from_deg < 170.0:
        raise BadInputError(f"{strike.what}: the sector from {from_deg:g}° to {to_deg:g}° must be 0° to 170° wide")
    bearings = np.degrees(beam_angles(scanner))
    across = np.cos(np.radians(bearings - (from_deg + to_deg) / 2))
    inside = (bearings >= from_deg) & (bearings <= to_deg)
    distance_m = hazard.distance_m or rng.uniform(*PLATE_M)
    return np.where(inside, distance_m / np.where(inside, across, 1.0), np.inf)
