"""The turns of a run's wheels: put right as the laser sees them, and told where the profile is wrong.

In: a run, and how its laser moved between pairs of scans. Out: the same run with its track or wheelbase, and wheels or
steering, as its turns ask for; and how sure that is. Two driven wheels count turns that are linear in what is wrong:
`turn_calibration`. A steered wheel does not, a zero 5° off leaves a few percent of the turns: `steering_calibration`.

How far the wheels go is `calibration`'s, after this: a track is only known once the radii are.
"""

from dataclasses import dataclass, replace

import msgspec
import numpy as np
from numpy.typing import NDArray

from hw_profiles.profile import Profile
from processing.calibration import PRIOR, Pairs, pairs_of
from processing.geometry import wrap_angle
from processing.open_loop import mount_pose
from processing.read_log import Run
from processing.sensor_calibration import PRIORS, LaserPairs
from processing.steering_calibration import RADIUS, WHEELBASE, ZERO, Drive, fit_steering
from processing.turn_calibration import PRIOR_BIAS_PER_M, PRIOR_SCALE, WheelTurn, fit_turn, put_right

Array = NDArray[np.float64]

WHEELS_M = 0.05  # how well the wheels know a few metres, where the walls do not show them
SIGNIFICANT = 3.0  # standard deviations; what is wrong by less is not told, nor what is wrong by less than
WORTH_SIZE, WORTH_RADII, WORTH_ZERO_RAD = 0.02, 0.02, np.radians(0.5)


@dataclass(frozen=True, slots=True)
class TurnFit:
    """What was found of the turns."""

    size_sigma: float  # of the track or the wheelbase over a wheel's radius, as a share of it
    veer: float  # radius of the right wheel over that of the left, less 1; or what the steering's zero lacks [rad]
    veer_sigma: float


def calibrate_turns(run: Run, pairs: LaserPairs) -> tuple[Run, Pairs, TurnFit | None]:
    """The run with its turns put right, and the pairs beside what its wheels count of the way; as it is without wheels.

    Two driven wheels count the same way ahead however they turn; a steered one may not.
    """
    if run.wheels is not None and run.profile.vehicle is not None and run.profile.vehicle.kinematics == "tricycle":
        run, found = _calibrate_steering(run, run.wheels, pairs)
        return run, pairs_of(run, pairs), found
    motions = pairs_of(run, pairs)
    if run.wheels is None:
        return run, motions, None
    turn = turn_of(motions)
    profile, wheels = put_right(run.profile, run.wheels, 1.0, turn)
    track_m, sigmas = _size(profile), np.sqrt(np.diag(turn.covariance))
    found = TurnFit(float(sigmas[0]), turn.bias_per_m * track_m, float(sigmas[1]) * track_m)
    return replace(run, profile=profile, wheels=wheels), motions, found


def turn_of(pairs: Pairs) -> WheelTurn:
    """From all pairs: smooth walls show headings too, once the wheels say how far it was."""
    known = np.linalg.inv(np.linalg.inv(pairs.covariances) + np.diag([WHEELS_M**-2, 0.0, 0.0]))
    change = wrap_angle(pairs.seen[:, 2] - pairs.counted[:, 2])
    half = pairs.counted[:, 2] / 2
    ahead_m = pairs.counted[:, 0] / np.cos(half) / np.sinc(half / np.pi)  # the arc over its chord
    return fit_turn(pairs.counted[:, 2], ahead_m, pairs.counted[:, 2] + change, known[:, 2, 2])


def _calibrate_steering(run: Run, wheels: Array, pairs: LaserPairs) -> tuple[Run, TurnFit]:
    """Zero and wheelbase of a tricycle.

    The gear is held, for in the curves of a drift a wrong one looks like a wrong wheelbase, which mends it as well. The
    mount is let go, for a base that sways otherwise than its wheels say must not bend the turns; but of it
    `sensor_calibration` has judged, and of the radius `calibration` will.
    """
    vehicle, base_m = run.profile.vehicle, _size(run.profile)
    assert vehicle is not None
    radius_m = run.profile.encoder("drive_wheel").wheel_radius_m
    assert radius_m is not None  # parse_profile has checked it
    guess = np.array([1.0, 0.0, radius_m, base_m, *mount_pose(run)])
    prior = np.array([0.0, PRIOR_BIAS_PER_M * base_m, PRIOR * radius_m, PRIOR_SCALE * base_m, *PRIORS[:3]])
    drive = Drive(run.motion_times, wheels, vehicle.drive_axle)
    fit = fit_steering(drive, run.scans.times[pairs.ends], pairs.motions, pairs.covariances, guess, prior)
    share = np.zeros(len(guess))  # of the logarithm of wheelbase over radius
    share[WHEELBASE], share[RADIUS] = 1 / fit.value[WHEELBASE], -1 / fit.value[RADIUS]
    zero = float(fit.value[ZERO])
    vehicle = msgspec.structs.replace(vehicle, wheelbase_m=float(fit.value[WHEELBASE] * radius_m / fit.value[RADIUS]))
    run = replace(
        run,
        profile=msgspec.structs.replace(run.profile, vehicle=vehicle),
        wheels=wheels + np.array([0.0, zero]),
    )
    return run, TurnFit(float(np.sqrt(share @ fit.covariance @ share)), zero, float(fit.sigma[ZERO]))


def tell_turns(before: Profile, after: Profile, found: TurnFit | None, way_sigma: float) -> list[str]:
    """A line for each figure of the profile `before` that is surely wrong; the wheels' way is known to `way_sigma`."""
    if found is None or before.vehicle is None:
        return []
    steered = before.vehicle.kinematics == "tricycle"
    told, was_m, is_m = [], _size(before), _size(after)
    sigma = float(np.hypot(found.size_sigma, way_sigma))
    if abs(was_m / is_m - 1) > max(WORTH_SIZE, SIGNIFICANT * sigma):
        what = "wheelbase_m" if steered else "track_width_m"
        told.append(f"the vehicle's {what} of {was_m:.3f} is {is_m:.3f} ± {is_m * sigma:.3f} m")
        if steered:
            told[-1] += ", if the steering's counts_per_turn is right"
    if abs(found.veer) > max(WORTH_ZERO_RAD if steered else WORTH_RADII, SIGNIFICANT * found.veer_sigma):
        if steered:
            encoder, lacks = before.encoder("steering"), float(np.degrees(found.veer))
            is_deg = encoder.zero_deg + (lacks if encoder.reversed else -lacks)
            doubt = f"{np.degrees(found.veer_sigma):.2f}°"
            told.append(f"the steering's zero_deg of {encoder.zero_deg:.2f} is {is_deg:.2f} ± {doubt}")
        else:
            larger, smaller = ("right", "left") if found.veer > 0 else ("left", "right")
            share = f"{100 * abs(found.veer):.1f} ± {100 * found.veer_sigma:.1f} %"
            told.append(f"the {larger} wheel's radius over the {smaller}'s is {share} more than in the profile")
    return told


def _size(profile: Profile) -> float:
    """Track or wheelbase."""
    vehicle = profile.vehicle
    assert vehicle is not None
    size_m = vehicle.track_width_m if vehicle.kinematics == "differential" else vehicle.wheelbase_m
    assert size_m is not None  # parse_profile has checked it
    return size_m
