"""Calibration of turns: what the wheels of a run say wrongly about its headings, as far as the laser can tell.

In: how the vehicle turned between pairs of scans, by its wheels and by the matches. Out: two numbers, turn = scale ·
counted turn + bias · way, and their covariance; and a profile and wheels put right by them. A track that is wider than
the profile says shows as scale; wheels of unequal radius, or a steering zero that is off, show as bias.

The laser sees headings in every drift, so little of this reaches a map; it makes first guesses good, and coasting where
nothing is seen at all.
"""

from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from hw_profiles.profile import Profile

Array = NDArray[np.float64]

PRIOR_SCALE, PRIOR_BIAS_PER_M = 0.03, 0.02  # rad/m: wheels 3 % apart on a track of 1.6 m, or a steering zero 2° off
PAIR_NOISE_RAD = 0.003  # what slip leaves of one pair
AT_ONCE = 2.0  # pairs overlap and share their slip: so many of them count as one
SIGMA_OF_MEDIAN = 1.4826


@dataclass(frozen=True, slots=True)
class WheelTurn:
    """True turn = scale · counted turn + bias · way driven ahead."""

    scale: float
    bias_per_m: float  # rad/m
    covariance: Array  # (2, 2)


AS_COUNTED = WheelTurn(1.0, 0.0, np.zeros((2, 2)))


def fit_turn(counted: Array, ahead_m: Array, seen: Array, variances: Array) -> WheelTurn:
    """Robust least squares over k pairs, drawn to a scale of 1 and no bias by what is known of wheels beforehand.

    Args:
        counted: (k,) turns by the wheels [rad].
        ahead_m: (k,) ways; in reverse negative.
        seen: (k,) turns by the matches.
        variances: (k,) of those.
    """
    # What the wheels count is regressed on what matches see, not the other way: slip makes the wheels the noisy ones.
    design = np.column_stack([seen, ahead_m])
    prior = np.diag([PRIOR_SCALE**-2, PRIOR_BIAS_PER_M**-2])
    change: Array = np.zeros(2)
    information: Array = prior
    for _ in range(20):
        residuals = counted - seen - design @ change
        spread = SIGMA_OF_MEDIAN * float(np.median(np.abs(residuals))) if len(seen) else 0.0
        noise = variances + max(PAIR_NOISE_RAD, spread) ** 2  # wide as long as the change is poor
        weights = 1 / (AT_ONCE * noise * (1 + residuals**2 / (4 * noise)) ** 2)  # Geman-McClure
        information = np.asarray(prior + design.T @ (weights[:, None] * design), np.float64)
        change = np.asarray(np.linalg.solve(information, design.T @ (weights * (counted - seen))), np.float64)
    scale = 1 / (1 + float(change[0]))
    return WheelTurn(scale, -scale * float(change[1]), np.asarray(np.linalg.inv(information), np.float64))


def put_right(profile: Profile, wheels: Array, scale: float, turn: WheelTurn) -> tuple[Profile, Array]:
    """The profile and the angles (m, 2) with which the wheels count `scale` times the way, and turns as they were."""
    vehicle = profile.vehicle
    assert vehicle is not None
    if vehicle.kinematics == "differential":
        assert vehicle.track_width_m is not None  # parse_profile has checked it
        track_m = scale * vehicle.track_width_m / turn.scale
        apart = turn.bias_per_m * track_m / 2
        vehicle = msgspec.structs.replace(vehicle, track_width_m=track_m)
        wheels = wheels * np.array([scale - apart, scale + apart])
    else:
        assert vehicle.wheelbase_m is not None
        wheelbase_m = scale * vehicle.wheelbase_m / turn.scale
        zero = turn.bias_per_m * wheelbase_m / scale  # tan δ ≈ δ near straight ahead, where most of the way is driven
        vehicle = msgspec.structs.replace(vehicle, wheelbase_m=wheelbase_m)
        wheels = wheels * np.array([scale, 1.0]) + np.array([0.0, zero])
    return msgspec.structs.replace(profile, vehicle=vehicle), wheels
