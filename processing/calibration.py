"""Calibration: by how much the wheels of a run count too little or too much, as far as the laser can tell.

In: a run, and pairs of its scans compared. Out: the same run with its wheels put right. Real wheels are wrong by a
percent or two, always the same way: a worn tyre, a wrong radius in the profile. Where the walls are rough, or a
crossing comes by, scan matches see how far the vehicle really went; what is learnt there is carried into the drifts
where the laser sees nothing along the way.

What they say wrongly about turns is put right before: `wheel_turns`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np
from numpy.typing import NDArray

from hw_profiles.profile import Profile
from processing.geometry import accumulate, compose, interpolate_poses, inverse, relative
from processing.open_loop import drive_blind, mount_pose, odometry_at_scans
from processing.read_log import Run
from processing.scan_match import through_mount
from processing.scan_matching import match_scans
from processing.sensor_calibration import LaserPairs
from processing.sweeps import Sweeps, sweeps_of
from processing.turn_calibration import AS_COUNTED, put_right

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

STRIDES_M = (2.0, 4.0)  # between two scans that are compared
MAX_PAIRS = 400  # of each stride
COMPARED_AT_ONCE = 50
MAX_TURN_RAD = 0.3  # in a curve, arc and chord differ
MOST_TURN_RAD = 1.0  # beyond, a scanner sees too little twice
MIN_INLIERS = 0.8
MAX_SIGMA_M = 0.02  # a match that knows the way less well says nothing of a percent
PAIR_NOISE_M = 0.01  # what slip and roughness leave of one pair
MEDIAN = 0.455  # of chi squared with one degree of freedom
PRIOR = 0.02  # wheels err by so much, before anything is known
AT_ONCE = 1.6  # pairs overlap and share their scans: so many of them count as one; and where
ALL_AT_ONCE = 4.0  # slip outweighs what matches err by, as many as every metre lies in: two of each stride
LEAST_NOISE = 0.25  # of the profile's: what wheels do where nobody sees them is not better known than that
MAX_SIGMA = 0.003  # an estimate less sure than this is left alone


@dataclass(frozen=True, slots=True)
class WheelScale:
    """True over counted distance; and its standard deviation."""

    scale: float
    sigma: float
    pairs: int
    noise_m_per_sqrt_m: float  # what is left at random, by the square root of the way; NaN where nothing was seen


@dataclass(frozen=True, slots=True)
class Pairs:
    """k pairs of scans that match."""

    counted: Array  # (k, 3) motions of the vehicle by its wheels
    seen: Array  # (k, 3) by the matches
    covariances: Array  # (k, 3, 3) of those


def calibrate(run: Run, pairs: Pairs) -> tuple[Run, WheelScale]:
    """The run with its distances as the laser sees them, or as they were where it sees too little; turns stay."""
    found = scale_of(pairs)
    if found.sigma > MAX_SIGMA:
        found = replace(found, scale=1.0)
    if run.odometry is not None:
        return replace(run, odometry=run.odometry * np.array([found.scale, found.scale, 1.0])), found
    assert run.wheels is not None
    profile, wheels = put_right(run.profile, run.wheels, found.scale, AS_COUNTED)
    if found.sigma <= MAX_SIGMA:
        profile = _with_noise(profile, found.noise_m_per_sqrt_m)
    return replace(run, wheels=wheels, profile=profile), found


def _with_noise(profile: Profile, noise_m_per_sqrt_m: float) -> Profile:
    """The profile with the noise of the distance as it was seen, between its own and LEAST_NOISE of it."""
    assert profile.vehicle is not None
    noise = profile.vehicle.odometry_noise
    most = noise.distance_m_per_sqrt_m
    noise = msgspec.structs.replace(
        noise, distance_m_per_sqrt_m=float(np.clip(noise_m_per_sqrt_m, LEAST_NOISE * most, most))
    )
    return msgspec.structs.replace(profile, vehicle=msgspec.structs.replace(profile.vehicle, odometry_noise=noise))


@dataclass(frozen=True, slots=True)
class Strides:
    """Pairs of scans to compare, k of them; a stretch of the run's sweeps is all that is needed for it."""

    first: int  # of the run's scans
    sweeps: Sweeps
    ends: Ints  # (k, 2) sweeps of the stretch
    counted: Array  # (k, 3) motions of the vehicle by its wheels


def cut_strides(run: Run) -> list[Strides]:
    """All pairs that are worth comparing, a stretch after the other."""
    odometry = odometry_at_scans(run)
    sweeps = sweeps_of(run.scans, odometry, mount_pose(run))
    driven = accumulate(np.zeros(3), odometry.deltas)
    way = np.append(0.0, np.cumsum(np.hypot(*odometry.deltas[:, :2].T)))
    ends = stride_pairs(way)
    counted = relative(driven[ends[:, 0]], driven[ends[:, 1]])
    worth = (np.abs(counted[:, 2]) <= MOST_TURN_RAD) & (np.abs(counted[:, 0]) >= 0.5 * np.diff(way[ends])[:, 0])
    ends, counted = ends[worth], counted[worth]
    stretches = []
    for k in range(0, len(ends), COMPARED_AT_ONCE):
        some = ends[k : k + COMPARED_AT_ONCE]
        first, last = int(some.min()), int(some.max())
        stretches.append(Strides(first, sweeps.cut(first, last), some - first, counted[k : k + COMPARED_AT_ONCE]))
    return stretches


def compare_strides(strides: Strides) -> LaserPairs:
    """What scan matches see of the motions: of those pairs that match."""
    mount, matched, seen, covariances = strides.sweeps.mount, [], [], []
    for k, (first, last) in enumerate(strides.ends.tolist()):
        one, other = strides.sweeps.scan(first), strides.sweeps.scan(last)
        match = match_scans(one, other, compose(inverse(mount), compose(strides.counted[k], mount)))
        if match.converged and match.inliers >= MIN_INLIERS:
            matched.append(k)
            seen.append(match.motion)
            covariances.append(match.covariance)
    ends = strides.first + strides.ends[np.array(matched, np.int64)]
    return LaserPairs(ends, np.array(seen).reshape(-1, 3), np.array(covariances).reshape(-1, 3, 3))


def join_pairs(parts: Sequence[LaserPairs]) -> LaserPairs:
    return LaserPairs(
        np.concatenate([np.zeros((0, 2), np.int64), *(part.ends for part in parts)]),
        np.concatenate([np.zeros((0, 3)), *(part.motions for part in parts)]),
        np.concatenate([np.zeros((0, 3, 3)), *(part.covariances for part in parts)]),
    )


def pairs_of(run: Run, pairs: LaserPairs) -> Pairs:
    """The same as motions of the vehicle, beside what its wheels count."""
    at = interpolate_poses(run.motion_times, drive_blind(run), run.scans.times[pairs.ends.ravel()]).reshape(-1, 2, 3)
    return Pairs(relative(at[:, 0], at[:, 1]), *through_mount(mount_pose(run), pairs.motions, pairs.covariances))


def scale_of(pairs: Pairs) -> WheelScale:
    """From the pairs that drive straight on and whose walls show the way."""
    straight = np.abs(pairs.counted[:, 2]) <= MAX_TURN_RAD
    used = straight & (pairs.covariances[:, 0, 0] < MAX_SIGMA_M**2)
    variances = pairs.covariances[used, 0, 0] + PAIR_NOISE_M**2
    return fit_scale(pairs.counted[used, 0], pairs.seen[used, 0], variances)


def stride_pairs(way: Array) -> Ints:
    """Pairs (p, 2) of scans some metres apart, all along the way travelled (n,)."""
    pairs = [np.zeros((0, 2), np.int64)]
    for stride in STRIDES_M:
        firsts = np.unique(np.searchsorted(way, np.arange(0.0, way[-1] - stride, stride / 2)))
        firsts = firsts[:: max(1, -(-len(firsts) // MAX_PAIRS))]
        lasts = np.searchsorted(way, way[firsts] + stride)
        pairs.append(np.column_stack([firsts, lasts])[(firsts < lasts) & (lasts < len(way))])
    return np.concatenate(pairs)


def fit_scale(counted: Array, seen: Array, variances: Array) -> WheelScale:
    """Weighted robust mean of seen over counted distance, drawn to 1 by what is known of wheels beforehand.

    Where the pairs scatter by more than their variances say, wheels slip, and each pair says less (Birge's ratio).
    """
    if not len(seen):
        return WheelScale(1.0, PRIOR, 0, float("nan"))
    scale, information = 1.0, PRIOR**-2
    for _ in range(20):
        doubts = (seen - scale * counted) ** 2 / variances
        spread = max(1.0, float(np.median(doubts)) / MEDIAN)
        weights = counted**2 / (spread * variances) / (1 + doubts / spread / 4) ** 2  # Geman-McClure: some jumped
        information = PRIOR**-2 + float(weights.sum())
        scale = (PRIOR**-2 + float((weights / counted) @ seen)) / information
    noise = np.sqrt(np.median((seen - scale * counted) ** 2 / np.abs(counted)) / MEDIAN)
    at_once = AT_ONCE / spread + ALL_AT_ONCE * (1 - 1 / spread)
    return WheelScale(float(scale), (information / at_once) ** -0.5, len(counted), float(noise))
