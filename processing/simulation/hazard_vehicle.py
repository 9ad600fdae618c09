"""Hazards of the vehicle: what its profile says wrongly, and what its wheels count wrongly.

In: a profile, or joint positions as they would have been counted. Out: the true vehicle; the positions as they were.
The vehicle's motion is true throughout, so each hazard is a change of what is counted between two ticks.
"""

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from hw_profiles.profile import Lasers, Mount, Profile
from processing.simulation.hazards import (
    Jump,
    LostCounts,
    Reset,
    Slide,
    Slip,
    Spin,
    Stuck,
    WheelHazard,
    WrongMount,
    WrongRadii,
    WrongTrack,
)
from processing.simulation.lots import Strike

Array = NDArray[np.float64]
MOUNT_M, MOUNT_DEG = 0.15, 3.0  # by lot, the most to either side
RADII, TRACK, SLIP = (0.97, 1.03), (0.95, 1.05), (0.4, 1.6)  # factors by lot


def true_profile(profile: Profile, strikes: list[Strike]) -> Profile:
    """The vehicle that drives where the recording holds `profile`."""
    for strike in strikes:
        hazard, rng = strike.hazard, strike.generator
        if isinstance(hazard, WrongMount):
            profile = _true_mount(profile, hazard, rng)
        elif isinstance(hazard, WrongRadii):
            encoders = []
            for encoder in profile.encoders:
                factor = hazard.factor or rng.uniform(*RADII)
                if encoder.wheel_radius_m is not None and hazard.wheel in (None, encoder.role):
                    encoder = replace(encoder, wheel_radius_m=encoder.wheel_radius_m / factor)
                encoders.append(encoder)
            profile = replace(profile, encoders=encoders)
        elif isinstance(hazard, WrongTrack) and profile.vehicle is not None:
            key = "track_width_m" if profile.vehicle.kinematics == "differential" else "wheelbase_m"
            true_m = getattr(profile.vehicle, key) / (hazard.factor or rng.uniform(*TRACK))
            profile = replace(profile, vehicle=replace(profile.vehicle, **{key: true_m}))
    return profile


def _true_mount(profile: Profile, hazard: WrongMount, rng: np.random.Generator) -> Profile:
    off = (hazard.dx_m, hazard.dy_m, hazard.dyaw_deg)
    if off == (None, None, None):
        off = tuple((rng.uniform(-1.0, 1.0, 3) * [MOUNT_M, MOUNT_M, MOUNT_DEG]).tolist())
    dx_m, dy_m, dyaw_deg = (each or 0.0 for each in off)
    laser = profile.lasers.primary
    mount = Mount(x_m=laser.mount.x_m - dx_m, y_m=laser.mount.y_m - dy_m, yaw_deg=laser.mount.yaw_deg - dyaw_deg)
    lasers = Lasers(primary=replace(laser, mount=mount), auxiliary=profile.lasers.auxiliary)
    return replace(profile, lasers=lasers)


def miscount(strike: Strike, positions: Array, time_s: Array, profile: Profile) -> Array:
    """Joint positions (n, encoders) in radians, latched at `time_s` (n,), as a wheel hazard leaves them.

    Only wheels go on from where the hazard left them; a steering angle that was stuck is right again at the end.
    """
    hazard, rng = strike.hazard, strike.generator
    assert isinstance(hazard, WheelHazard)
    roles = [encoder.role for encoder in profile.encoders]
    wheels = np.array([k for k, role in enumerate(roles) if role != "steering" and hazard.wheel in (None, role)])
    count = 2 * np.pi / np.array([encoder.counts_per_turn for encoder in profile.encoders])
    positions, turned = positions.copy(), np.diff(positions, axis=0, prepend=positions[:1])
    for start_s, end_s in strike.spans_s(float(time_s[-1])):
        ticks = np.flatnonzero((time_s > start_s) & (time_s <= end_s))
        first = int(np.searchsorted(time_s, start_s, side="right"))
        one = wheels[rng.integers(len(wheels))]
        match hazard:
            case Slip():
                turned[ticks, one] *= hazard.factor or rng.uniform(*SLIP)
            case Spin():
                for wheel in wheels.tolist():
                    radius_m = profile.encoders[wheel].wheel_radius_m or 1.0
                    extra = hazard.extra_m_s / radius_m * np.diff(time_s, prepend=time_s[0])[ticks]
                    turned[ticks, wheel] += np.where(turned[ticks, wheel] < 0, -extra, extra)
            case Slide():
                turned[ticks[:, None], wheels] = 0.0
            case Stuck():
                turned[ticks[:, None], wheels] = 0.0
                if hazard.wheel is None and "steering" in roles and first > 0:
                    positions[ticks, roles.index("steering")] = positions[first - 1, roles.index("steering")]
            case Jump() if first < len(turned):
                turned[first, one] += 2 * np.pi * (hazard.turns or rng.uniform(-1.0, 1.0))
            case Reset() if 0 < first < len(turned):
                reached = positions[0, wheels] + turned[:first, wheels].sum(axis=0)
                turned[first, wheels] = -reached
            case LostCounts():
                counted = np.round(np.abs(turned[ticks, one]) / count[one]).astype(np.int64)
                lost = rng.binomial(counted, hazard.share) * count[one]
                turned[ticks, one] -= np.sign(turned[ticks, one]) * lost
            case _:
                pass
    counted = positions[0] + np.cumsum(turned, axis=0)
    positions[:, wheels] = (np.floor(counted / count + 0.5) * count)[:, wheels]
    return positions
