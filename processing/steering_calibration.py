"""Steering calibration: what a tricycle's profile says wrongly of its steering, its wheel and its sensor.

In: angles of the drive wheel's and the steering's encoders, and how a sensor moved between pairs of instants. Out: gear
and zero of the steering, radius of the drive wheel, wheelbase and mount of the sensor, with their covariance.
Censi et al. (2013) solve the like for two driven wheels in closed form. A steered wheel allows none: this is least
squares of the motions as they are, with no figure linearised, so that a first guess may be far off.

                  ┌─┐ steered by gear · encoder + zero
                  └┬┘
        sensor ●   │ wheelbase          base: the middle of the rear axle, which does not slip sideways
                ┌──┴──┐

Not all of it shows in every drive. Steering little, gear and wheelbase are known by their ratio only; the place of the
sensor shows in turns only. So the covariance comes with the figures, and what is known better than a drive shows it is
held, or goes in as a prior.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import OptimizeResult, least_squares

from processing.geometry import accumulate, compose, interpolate_poses, inverse, relative, wrap_angle
from processing.odometry import arc, steered_steps
from processing.scan_match import through_mount
from processing.sensor_calibration import AT_ONCE, MEDIAN, PAIR_NOISE

Array = NDArray[np.float64]

NAMES = ("gear", "zero", "radius", "wheelbase", "mount x", "mount y", "mount yaw")  # -, rad, m, m, m, m, rad
GEAR, ZERO, RADIUS, WHEELBASE = range(4)
MOUNT = slice(4, 7)
SCALES = np.array([0.1, 0.1, 0.01, 0.1, 0.1, 0.1, 0.1])  # of a step, so that one figure counts as much as another
OTHER_GEARS = (1.0, 0.2, 0.5, 2.0, 5.0)  # starts, where nothing is known of it: its cost has more than one valley
CORNER = 1.0  # beyond so much, a residual is doubted


@dataclass(frozen=True, slots=True)
class Drive:
    """m samples of the encoders of a tricycle."""

    times: Array  # (m,) s, rising
    wheels: Array  # (m, 2) rad: of the drive wheel, without wraps; of the steering's encoder
    axle: Literal["rear", "front"]  # whose wheel the first of them is


@dataclass(frozen=True, slots=True)
class SteeringFit:
    """The figures in the order of NAMES, and how sure they are."""

    value: Array  # (7,)
    covariance: Array  # (7, 7); zero of what was held

    @property
    def sigma(self) -> Array:
        return np.asarray(np.sqrt(np.diag(self.covariance)))


def base_poses(drive: Drive, value: Array, at: Array) -> Array:
    """Dead reckoning with figures (7,): poses (n, 3) of the base at times `at` (n,), its first sample at zero."""
    steering = value[GEAR] * drive.wheels[:, 1] + value[ZERO]
    ahead, turns = steered_steps(np.diff(drive.wheels[:, 0]) * value[RADIUS], steering, value[WHEELBASE], drive.axle)
    base = accumulate(np.zeros(3), arc(np.column_stack([ahead, turns, np.zeros(len(turns))])))
    return interpolate_poses(drive.times, base, at)


def fit_steering(
    drive: Drive, ends_s: Array, motions: Array, covariances: Array, guess: Array, prior: Array
) -> SteeringFit:
    """Robust least squares over k pairs.

    Args:
        drive: the samples.
        ends_s: (k, 2) times between which the sensor moved.
        motions: (k, 3) how it did, in its own frame [m, m, rad].
        covariances: (k, 3, 3) of those.
        guess: (7,) first guess of the figures.
        prior: (7,) standard deviations of that guess; infinite where it is none, 0 holds a figure.
    """
    free = prior > 0

    def off(value: Array) -> Array:
        """(k, 3) what the wheels count less what the sensor saw, of the base."""
        mount = value[MOUNT]
        poses = base_poses(drive, value, ends_s.ravel()).reshape(-1, 2, 3)
        seen = compose(compose(mount, motions), inverse(mount))
        residuals = relative(poses[:, 0], poses[:, 1]) - seen
        residuals[:, 2] = wrap_angle(residuals[:, 2])
        return residuals

    def solve(start: Array, spread: float = 1.0, in_wheels: bool = False) -> tuple[Array, OptimizeResult]:
        _, seen_covariances = through_mount(start[MOUNT], motions, covariances)
        whiten = np.linalg.cholesky(np.linalg.inv(seen_covariances + np.diag(PAIR_NOISE**2)))

        def residuals(chosen: Array) -> Array:
            value = _with(guess, free, chosen)
            unit = _gains(start) / _gains(value) if in_wheels else 1.0
            whitened = np.einsum("kij,ki->kj", whiten, off(value) * unit)
            return np.append(whitened / np.sqrt(AT_ONCE * spread), (chosen - guess[free]) / prior[free])

        found = least_squares(residuals, start[free], x_scale=SCALES[free], loss="cauchy", f_scale=CORNER)
        return _with(guess, free, found.x), found

    gears = OTHER_GEARS if np.isinf(prior[GEAR]) else (1.0,)
    starts = [guess * np.where(np.arange(len(NAMES)) == GEAR, times, 1.0) for times in gears]
    value, found = min((solve(start) for start in starts), key=lambda solved: float(solved[1].cost))
    squares = AT_ONCE * np.sum(found.fun[: motions.size].reshape(-1, 3) ** 2, axis=1)
    spread = max(1.0, float(np.median(squares)) / MEDIAN) if len(squares) else 1.0
    # Where the pairs scatter by more than they say, each says less (Birge's ratio). Most of it is the wheels', so once
    # the way is clear it is weighed as the wheels count it; else small gains would look good for making it small.
    value, found = solve(value, spread, in_wheels=True)
    covariance = np.zeros((len(NAMES), len(NAMES)))
    covariance[np.ix_(free, free)] = np.linalg.inv(found.jac.T @ found.jac)
    return SteeringFit(value, covariance)


def _gains(value: Array) -> Array:
    """How far ahead, to the side and round (3,) the base goes by a little of the encoders."""
    turn = value[GEAR] * value[RADIUS] / value[WHEELBASE]
    return np.array([value[RADIUS], turn, turn])


def _with(value: Array, free: NDArray[np.bool_], chosen: Array) -> Array:
    changed = value.copy()
    changed[free] = chosen
    return changed
