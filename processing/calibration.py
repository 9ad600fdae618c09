"""Calibration: by how much the wheels of a run count too little or too much, as far as the laser can tell.

In: a run. Out: the same run with its wheels put right. Real wheels are wrong by a percent or two, always the same
way: a worn tyre, a wrong radius in the profile. Where the walls are rough, or a crossing comes by, scan matches see
how far the vehicle really went; what is learnt there is carried into the drifts where the laser sees nothing along
the way.

Only the scale of the distance is estimated: headings are seen by the laser in every drift, so errors of track width and
steering do not stay.
"""

from dataclasses import dataclass, replace

import msgspec
import numpy as np
from numpy.typing import NDArray

from hw_profiles.profile import Profile
from processing.geometry import accumulate, compose, inverse, relative
from processing.open_loop import mount_pose, odometry_at_scans
from processing.read_log import Run
from processing.scan_match import through_mount
from processing.scan_matching import match_scans
from processing.sweeps import sweeps_of

Array = NDArray[np.float64]

STRIDES_M = (2.0, 4.0)  # between two scans that are compared
MAX_PAIRS = 400  # of each stride
MAX_TURN_RAD = 0.3  # in a curve, arc and chord differ
MIN_INLIERS = 0.8
MAX_SIGMA_M = 0.02  # a match that knows the way less well says nothing of a percent
PAIR_NOISE_M = 0.01  # what slip and roughness leave of one pair
MEDIAN = 0.455  # of chi squared with one degree of freedom
PRIOR = 0.02  # wheels err by so much, before anything is known
AT_ONCE = 1.6  # pairs overlap and share their slip: so many of them count as one
LEAST_NOISE = 0.25  # of the profile's: what wheels do where nobody sees them is not better known than that
MAX_SIGMA = 0.003  # an estimate less sure than this is left alone


@dataclass(frozen=True, slots=True)
class WheelScale:
    """True over counted distance; and its standard deviation."""

    scale: float
    sigma: float
    pairs: int
    noise_m_per_sqrt_m: float  # what is left at random, by the square root of the way; NaN where nothing was seen


def calibrate(run: Run) -> tuple[Run, WheelScale]:
    """The run with its distances as the laser sees them; as it was, with scale 1, where the laser sees too little."""
    found = estimate_scale(run)
    if found.sigma > MAX_SIGMA:
        return run, replace(found, scale=1.0)
    if run.odometry is not None:
        return replace(run, odometry=run.odometry * np.array([found.scale, found.scale, 1.0])), found
    assert run.wheels is not None
    assert run.profile.vehicle is not None  # a run with wheels has a profile that explains them
    is_differential = run.profile.vehicle.kinematics == "differential"
    steering = found.scale if is_differential else 1.0  # both wheels of a differential drive roll; steering does not
    known = _with_noise(run.profile, found.noise_m_per_sqrt_m)
    return replace(run, wheels=run.wheels * np.array([found.scale, steering]), profile=known), found


def _with_noise(profile: Profile, noise_m_per_sqrt_m: float) -> Profile:
    """The profile with the noise of the distance as it was seen, between its own and LEAST_NOISE of it."""
    assert profile.vehicle is not None
    noise = profile.vehicle.odometry_noise
    known = float(np.clip(noise_m_per_sqrt_m / noise.distance_m_per_sqrt_m, LEAST_NOISE, 1.0))
    noise = msgspec.structs.replace(noise, distance_m_per_sqrt_m=known * noise.distance_m_per_sqrt_m)
    return msgspec.structs.replace(profile, vehicle=msgspec.structs.replace(profile.vehicle, odometry_noise=noise))


def estimate_scale(run: Run) -> WheelScale:
    """Compare what the wheels count over a few metres with what scan matches see of it."""
    odometry, mount = odometry_at_scans(run), mount_pose(run)
    sweeps = sweeps_of(run.scans, odometry, mount)
    driven = accumulate(np.zeros(3), odometry.deltas)
    way = np.append(0.0, np.cumsum(np.hypot(*odometry.deltas[:, :2].T)))
    counted, seen, variances = [], [], []
    for first, last in stride_pairs(way):
        guess = relative(driven[first], driven[last])
        if abs(guess[2]) > MAX_TURN_RAD or abs(guess[0]) < 0.5 * (way[last] - way[first]):
            continue
        one, other = sweeps.scan(first), sweeps.scan(last)
        match = match_scans(one, other, compose(inverse(mount), compose(guess, mount)))
        motion, covariance = through_mount(mount, match.motion, match.covariance)
        if match.converged and match.inliers >= MIN_INLIERS and covariance[0, 0] < MAX_SIGMA_M**2:
            counted.append(guess[0])
            seen.append(motion[0])
            variances.append(covariance[0, 0] + PAIR_NOISE_M**2)
    return fit_scale(np.array(counted), np.array(seen), np.array(variances))


def stride_pairs(way: Array) -> list[tuple[int, int]]:
    """Pairs of scans some metres apart, all along the way travelled (n,)."""
    pairs: list[tuple[int, int]] = []
    for stride in STRIDES_M:
        firsts = np.unique(np.searchsorted(way, np.arange(0.0, way[-1] - stride, stride / 2)))
        firsts = firsts[:: max(1, -(-len(firsts) // MAX_PAIRS))]
        lasts = np.searchsorted(way, way[firsts] + stride)
        pairs += [(int(a), int(b)) for a, b in zip(firsts, lasts, strict=True) if a < b < len(way)]
    return pairs


def fit_scale(counted: Array, seen: Array, variances: Array) -> WheelScale:
    """Weighted robust mean of seen over counted distance, drawn to 1 by what is known of wheels beforehand."""
    scale, information = 1.0, PRIOR**-2
    for _ in range(20):
        doubts = (seen - scale * counted) ** 2 / variances
        weights = counted**2 / variances / (1 + doubts / 4) ** 2  # Geman-McClure: a match that jumped is none
        information = PRIOR**-2 + float(weights.sum())
        scale = (PRIOR**-2 + float((weights / counted) @ seen)) / information
    noise = float(np.sqrt(np.median((seen - scale * counted) ** 2 / np.abs(counted)) / MEDIAN)) if len(seen) else np.nan
    return WheelScale(float(scale), (information / AT_ONCE) ** -0.5 if len(seen) else PRIOR, len(counted), noise)
