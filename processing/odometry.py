"""Odometry: how the vehicle moved between two samples, as its wheels tell, and how far that can be trusted.

In: wheel and steering angles [rad], or the poses of another system's odometry. Out: `Motions`, each in the frame of the
pose before it, with the covariance of (x, y, θ) [m, m, rad].

Its law: all that is measured are increments of angles, so a step is as long as the real time between two samples; a
missing tick makes one longer step, no error. The wheels roll on an arc, and the arc is integrated exactly, where
eq. (1) of Lavigne & Marshall (2012) takes Euler's step: the two agree as the turn of a step goes to zero.

                     . motion  x, y                inputs of a step: distance along the arc, turn θ, and the slip
                . ´ ) θ                            across the chord, which the wheels cannot see: its mean is zero,
    pose k  ● ´ ──────── x  ahead                  its variance is not
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from hw_profiles.profile import OdometryNoise, Profile
from processing import geometry

Array = NDArray[np.float64]

# What a vehicle that stands still may still have moved: below the resolution of any wheel encoder.
STANDING_M = 1e-4
STANDING_RAD = 2e-5
# What no vehicle does, wherever it is asked: to drive or turn faster, or to change its motion as fast.
MAX_M_S, MAX_RAD_S = 20.0, 5.0
SPEED_UP_M_S2, TURN_UP_RAD_S2 = 6.0, 4.0


@dataclass(frozen=True, slots=True)
class Motions:
    """n motions in a row: each in the frame of the pose before it."""

    deltas: Array  # (n, 3) x [m], y [m], θ [rad]
    covariances: Array  # (n, 3, 3) of the three numbers of a delta
    guessed: NDArray[np.bool_] | None = None  # (n,) in place of steps that no vehicle makes, where there are any


def wheel_motions(profile: Profile, first: Array, second: Array) -> Motions:
    """The motions between n samples of the encoders.

    `first` and `second` (n,) are the angles [rad] in the order of `hw_profiles.profile.ROLES`: left and right wheel, or
    drive wheel and steering (positive to the left, zero straight ahead). Angles at other times, such as those of the
    scans, are interpolated before: the steps then follow.
    """
    distances, turns = wheel_steps(profile, first, second)
    assert profile.vehicle is not None  # parse_profile has checked it: there are encoders
    return _motions(np.column_stack([distances, turns, np.zeros(len(turns))]), profile.vehicle.odometry_noise)


def wheel_steps(profile: Profile, first: Array, second: Array) -> tuple[Array, Array]:
    """Distance [m] and turn [rad], each (n - 1,), of the vehicle's origin: the middle of its (rear) axle."""
    vehicle = profile.vehicle
    assert vehicle is not None
    if vehicle.kinematics == "differential":
        left = np.diff(first) * _radius(profile, "left_wheel")
        right = np.diff(second) * _radius(profile, "right_wheel")
        return (left + right) / 2, (right - left) / _size(vehicle.track_width_m)
    rolled = np.diff(first) * _radius(profile, "drive_wheel")
    return steered_steps(rolled, second, _size(vehicle.wheelbase_m), vehicle.drive_axle)


def steered_steps(
    rolled_m: Array, steering: Array, wheelbase_m: float, axle: Literal["rear", "front"]
) -> tuple[Array, Array]:
    """The same of a tricycle whose wheel on this axle rolled so far (n - 1,), with steering angles (n,) [rad]."""
    middle = (steering[1:] + steering[:-1]) / 2  # of the step
    if axle == "front":  # the wheel rolls along its own heading, not the vehicle's
        return rolled_m * np.cos(middle), rolled_m * np.sin(middle) / wheelbase_m
    return rolled_m, rolled_m * np.tan(middle) / wheelbase_m


def odom_motions(poses: Array, noise: OdometryNoise) -> Motions:
    """The motions between poses (n, 3) of someone else's odometry, with the covariance that wheels would have."""
    deltas = geometry.relative(poses[:-1], poses[1:])
    half = deltas[:, 2] / 2
    along = np.cos(half) * deltas[:, 0] + np.sin(half) * deltas[:, 1]
    across = -np.sin(half) * deltas[:, 0] + np.cos(half) * deltas[:, 1]
    return _motions(np.column_stack([along / np.sinc(half / np.pi), deltas[:, 2], across]), noise)


def dead_reckon(motions: Motions, start: Array | None = None) -> Array:
    """Poses (n + 1, 3), from `start` (3,) or zero, one motion after the other (eq. 2)."""
    return geometry.accumulate(np.zeros(3) if start is None else start, motions.deltas)


def arc(inputs: Array) -> Array:
    """Motions (..., 3) that inputs (..., 3) lead to: distance along the arc, turn, slip across its chord."""
    distance, turn, slip = inputs[..., 0], inputs[..., 1], inputs[..., 2]
    chord = distance * np.sinc(turn / (2 * np.pi))  # sin(θ/2) / (θ/2)
    c, s = np.cos(turn / 2), np.sin(turn / 2)
    return np.stack([c * chord - s * slip, s * chord + c * slip, turn], axis=-1)


def input_variances(inputs: Array, noise: OdometryNoise) -> Array:
    """Variances (n, 3) of distance, turn and slip: in proportion to the way, so that two halves make a whole."""
    metres, degrees = np.abs(inputs[:, 0]), np.degrees(np.abs(inputs[:, 1]))
    scrub = noise.position_m_per_sqrt_deg**2 * degrees + STANDING_M**2
    along = noise.distance_m_per_sqrt_m**2 * metres + scrub
    across = noise.lateral_m_per_sqrt_m**2 * metres + scrub
    heading = noise.heading_deg_per_sqrt_m**2 * metres + noise.heading_deg_per_sqrt_deg**2 * degrees
    return np.column_stack([along, np.radians(1) ** 2 * heading + STANDING_RAD**2, across])


def _motions(inputs: Array, noise: OdometryNoise) -> Motions:
    """The unscented transform of `unscented_motion`, for all steps at once.

    From a start that is known (each motion has its own frame) the sigma points of the state fall together, and those of
    the three inputs are left: the mean and ±√3 σ of each. The motion given is that of the measured inputs, not the mean
    of the sigma points (they differ in second order), so that dead reckoning does not depend on the noise.
    """
    spread = np.sqrt(3 * input_variances(inputs, noise))[:, None, :] * np.concatenate([np.eye(3), -np.eye(3)])
    centre, points = arc(inputs), arc(inputs[:, None, :] + spread)
    mean = points.mean(axis=1)
    residuals, bent = points - mean[:, None, :], centre - mean
    covariances = np.einsum("nki,nkj->nij", residuals, residuals) / 6 + 2 * np.einsum("ni,nj->nij", bent, bent)
    deltas = np.column_stack([centre[:, :2], geometry.wrap_angle(centre[:, 2])])
    return Motions(deltas, covariances)


def unscented_motion(pose: Array, covariance: Array, step: Array, variances: Array) -> tuple[Array, Array]:
    """The pose (3,) and its covariance after one step, by the augmented unscented transform (Julier & Uhlmann 2004).

    The plain form, slow: state and input noise in one vector of six, through filterpy's sigma points. It says what
    `wheel_motions` computes, and the tests hold that against it.

    Args:
        pose: (3,) before the step.
        covariance: (3, 3) of that pose.
        step: (3,) distance, turn and slip.
        variances: (3,) of the step, from `input_variances`.
    """
    from filterpy.kalman import MerweScaledSigmaPoints, unscented_transform  # its import takes a second

    def mean_pose(points: Array, weights: Array) -> Array:
        sine, cosine = weights @ np.sin(points[:, 2]), weights @ np.cos(points[:, 2])
        return np.array([*(weights @ points[:, :2]), np.arctan2(sine, cosine)])

    def residual(a: Array, b: Array) -> Array:
        return np.array([*(a[:2] - b[:2]), geometry.wrap_angle(a[2] - b[2])])

    sigmas = MerweScaledSigmaPoints(6, alpha=1.0, beta=2.0, kappa=-3.0)  # 3 - n: the kurtosis of a Gaussian
    augmented = np.zeros((6, 6))
    augmented[:3, :3], augmented[3:, 3:] = covariance, np.diag(variances)
    points = sigmas.sigma_points(np.concatenate([pose, step]), augmented)
    after = geometry.compose(points[:, :3], arc(points[:, 3:]))
    mean, spread = unscented_transform(after, sigmas.Wm, sigmas.Wc, mean_fn=mean_pose, residual_fn=residual)
    return mean, spread


def _radius(profile: Profile, role: str) -> float:
    return _size(profile.encoder(role).wheel_radius_m)


def _size(length_m: float | None) -> float:
    assert length_m is not None  # parse_profile has checked it
    return length_m
