"""Sensor calibration: where the scanner sits in the vehicle, and how late its stamps are, as far as the drive shows.

In: a run, and how its laser moved between pairs of scans (matches, in the laser's own frame). Out: what the profile and
the stamps say wrongly, each with its standard deviation. A laser at mount M on a vehicle that moves by V moves by
⊖M ⊕ V ⊕ M, and V is that of wheels that do not slip sideways: on a straight the direction of the laser's motion is the
mount's yaw, in a turn its sway is the mount's place, and where speed or turn rate change, a delay shows.

Wheels are wrong, too (`calibration`, `turn_calibration`), so all of it is estimated at once, and what is known of the
wheels is left to those. A figure is only used where the drive proves it wrong.
"""

from dataclasses import dataclass, replace

import msgspec
import numpy as np
from numpy.typing import NDArray

from hw_profiles.profile import Profile
from processing.even_clocks import with_even_clocks
from processing.geometry import accumulate, compose, interpolate_poses, inverse, relative, wrap_angle
from processing.open_loop import drive_blind, mount_pose
from processing.read_log import Run
from processing.scan_match import through_mount
from processing.turn_calibration import WheelTurn, put_right

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

# mount x [m], y [m] and yaw [rad], delay [s]; of the wheels: scale, turn, bias [rad/m], lag of the steering [s]
PRIORS = np.array([0.2, 0.2, 0.1, 0.1, 0.02, 0.03, 0.02, 0.05])
STEPS = np.array([1e-3, 1e-3, 1e-4, 1e-3, 1e-4, 1e-4, 1e-5, 1e-3])  # of the numeric derivatives
SENSOR = 4  # the first of them are of the sensor, the others of the wheels
FLOORS = np.array([0.05, 0.03, np.radians(0.2), 0.008, *[-np.inf] * 4])  # what is wrong by less is left alone
STANDS_M_S = 0.1
SURE = np.array([0.03, 0.03, np.radians(0.3), 0.01, *[np.inf] * 4])  # standard deviations above these say too little
SIGNIFICANT = 5.0  # standard deviations
PAIR_NOISE = np.array([0.01, 0.01, 0.003])  # m, m, rad: what slip and roughness leave of one pair
AT_ONCE = 4.0  # pairs overlap and share their scans: so many of them count as one
MEDIAN = 2.37  # of chi squared with three degrees of freedom
CORNER = 16.0  # squared standard deviations at which a pair is half doubted
ROUNDS = 6
EVENLY = 0.85  # times that leave so much less between wheels and walls are the true ones
LEAST_PAIRS = 20


@dataclass(frozen=True, slots=True)
class LaserPairs:
    """k pairs of scans that match."""

    ends: Ints  # (k, 2) scans of the run
    motions: Array  # (k, 3) of the laser
    covariances: Array  # (k, 3, 3)


@dataclass(frozen=True, slots=True)
class SensorFit:
    """By how much the profile and the stamps are off, and how sure that is: m, m, rad, s (4,)."""

    off: Array  # mount x, y, yaw; delay of the scans' stamps against those of the odometry
    sigma: Array
    used: NDArray[np.bool_]
    cost: float  # robust, of a pair on average


NOTHING = SensorFit(np.zeros(SENSOR), np.full(SENSOR, np.inf), np.zeros(SENSOR, bool), np.inf)


def fit_sensor(run: Run, pairs: LaserPairs) -> SensorFit:
    """What is surely wrong; all else is taken as the profile says."""
    if len(pairs.ends) < LEAST_PAIRS:
        return NOTHING
    free = np.ones(len(PRIORS), bool)
    free[-1] = (
        run.profile.vehicle is not None and run.profile.vehicle.kinematics == "tricycle" and run.wheels is not None
    )
    while True:
        value, sigma, cost = _fit(run, pairs, free)
        value[0] = _without_lag(value[0], run)
        proven = (np.abs(value) > np.maximum(SIGNIFICANT * sigma, FLOORS)) & (sigma < SURE)
        proven[SENSOR:] = True  # the wheels' are never left out
        if np.all(proven[free]) or not proven[:SENSOR].any():
            used = free[:SENSOR] & proven[:SENSOR]
            return SensorFit(np.where(used, value[:SENSOR], 0.0), sigma[:SENSOR], used, cost)
        # the least proven goes first: what it took from the others comes back to them
        doubt = np.where(free & ~proven, np.abs(value) / np.maximum(sigma, FLOORS), np.inf)
        free[int(np.argmin(doubt))] = False


def _without_lag(x_m: float, run: Run) -> float:
    """The mount's x, whether the odometry's steps were arcs or began with the heading of the sample before: then the
    vehicle looks as if its scanner sat half a step's way further back. In the middle of the two; 0 between them.
    """
    ways = np.hypot(*np.diff(drive_blind(run)[:, :2], axis=0).T)
    ways = ways[ways > STANDS_M_S * np.diff(run.motion_times)]
    step_m = float(np.median(ways)) if len(ways) else 0.0
    least, most = x_m, x_m + step_m / 2
    return 0.0 if least < FLOORS[0] and most > -FLOORS[0] else (least + most) / 2


def calibrate_sensor(run: Run, pairs: LaserPairs) -> tuple[Run, list[str]]:
    """The run with its mount and its times put right, and what was wrong, a line each."""
    found, lines = fit_sensor(run, pairs), []
    evened = with_even_clocks(run)
    if evened is not None:
        even = fit_sensor(evened, pairs)
        if even.cost < EVENLY * found.cost:
            run, found = evened, even
            scatter = np.std(run.scans.times - run.stamped[0]) if run.stamped is not None else 0.0
            lines.append(f"the stamps jitter by {1e3 * scatter:.0f} ms; even times were used")
    if not found.used.any():
        return run, lines
    return apply_fit(run, found), lines + tell(found, scans_late=_scans_are_late(run, found))


def _scans_are_late(run: Run, fit: SensorFit) -> bool:
    """Latency makes stamps late, never early, so the sign of a delay says whose they are. Another system's odometry is
    moved in any case: a scan's pose goes by the scan's stamp there.
    """
    return bool(fit.off[3] > 0) and run.wheels is not None


def apply_fit(run: Run, fit: SensorFit) -> Run:
    """The run with its mount put right, and the times of what is late."""
    x_m, y_m, yaw_rad, delay_s = fit.off.tolist()
    run = replace(run, profile=_with_mount(run.profile, x_m, y_m, yaw_rad))
    if delay_s == 0:
        return run
    stamped = run.stamped or (run.scans.times, run.motion_times)
    if _scans_are_late(run, fit):
        return replace(run, scans=replace(run.scans, times=run.scans.times - delay_s), stamped=stamped)
    moved = replace(run, motion_times=run.motion_times + delay_s)
    return replace(moved, stamped=stamped) if run.wheels is not None else moved


def _fit(run: Run, pairs: LaserPairs, free: NDArray[np.bool_]) -> tuple[Array, Array, float]:
    """Robust Gauss–Newton: values (8,), standard deviations (8,), and the mean cost of a pair."""
    value, chosen = np.zeros(len(PRIORS)), np.flatnonzero(free)
    informations = _informations(run, pairs)
    for _ in range(ROUNDS):
        residuals = _residuals(run, pairs, value)
        jacobian = np.stack(
            [(_residuals(run, pairs, value + STEPS * np.eye(len(PRIORS))[n]) - residuals) / STEPS[n] for n in chosen],
            -1,
        )
        squares = np.einsum("ki,kij,kj->k", residuals, informations, residuals)
        spread = max(1.0, float(np.median(squares)) / MEDIAN)
        weights = 1 / (1 + squares / spread / CORNER) ** 2 / (AT_ONCE * spread)  # Geman-McClure: some slipped
        weighted = np.einsum("kia,kij,k->kaj", jacobian, informations, weights)
        normal = np.einsum("kaj,kjb->ab", weighted, jacobian) + np.diag(PRIORS[chosen] ** -2)
        gradient = np.einsum("kaj,kj->a", weighted, residuals) + value[chosen] / PRIORS[chosen] ** 2
        step = np.linalg.solve(normal, gradient)
        value[chosen] -= step
        if np.all(np.abs(step) < 0.1 * STEPS[chosen]):
            break
    sigma = PRIORS.copy()
    sigma[chosen] = np.sqrt(np.diag(np.linalg.inv(normal)))
    return value, sigma, float(np.mean(squares / (CORNER + squares)))


def _informations(run: Run, pairs: LaserPairs) -> Array:
    """(k, 3, 3) of the vehicle's motions, with what slip leaves; where the walls leave a direction open, none."""
    _, covariances = through_mount(mount_pose(run), pairs.motions, pairs.covariances)
    return np.asarray(np.linalg.inv(covariances + np.diag(PAIR_NOISE**2)))


def _residuals(run: Run, pairs: LaserPairs, value: Array) -> Array:
    """(k, 3): motions of the vehicle as the laser saw them less those of the wheels, with other figures (8,)."""
    x_m, y_m, yaw_rad, delay_s, scale, turn, bias, lag_s = value.tolist()
    mount = mount_pose(run) + np.array([x_m, y_m, yaw_rad])
    seen = compose(compose(mount, pairs.motions), inverse(mount))
    driven = _dead_reckoned(run, 1 + scale, 1 + turn, bias, lag_s)
    at = interpolate_poses(run.motion_times + delay_s, driven, run.scans.times[pairs.ends.ravel()]).reshape(-1, 2, 3)
    residuals = seen - relative(at[:, 0], at[:, 1])
    residuals[:, 2] = wrap_angle(residuals[:, 2])
    return residuals


def _dead_reckoned(run: Run, scale: float, turn: float, bias: float, lag_s: float) -> Array:
    """Poses (m, 3) at the odometry's samples, by wheels that count otherwise."""
    if run.wheels is not None:
        profile, wheels = put_right(run.profile, run.wheels, scale, WheelTurn(turn, bias, np.zeros((2, 2))))
        if lag_s != 0:
            wheels[:, 1] = np.interp(run.motion_times - lag_s, run.motion_times, wheels[:, 1])
        return drive_blind(replace(run, profile=profile, wheels=wheels))
    assert run.odometry is not None
    steps = relative(run.odometry[:-1], run.odometry[1:])
    bent = steps * np.array([scale, scale, turn])
    bent[:, 2] += bias * steps[:, 0]
    return accumulate(np.zeros(3), bent)


def _with_mount(profile: Profile, x_m: float, y_m: float, yaw_rad: float) -> Profile:
    lasers = profile.lasers
    at, off_deg = lasers.primary.mount, float(np.degrees(yaw_rad))
    mount = msgspec.structs.replace(at, x_m=at.x_m + x_m, y_m=at.y_m + y_m, yaw_deg=at.yaw_deg + off_deg)
    primary = msgspec.structs.replace(lasers.primary, mount=mount)
    return msgspec.structs.replace(profile, lasers=msgspec.structs.replace(lasers, primary=primary))


def tell(fit: SensorFit, *, scans_late: bool) -> list[str]:
    """A line for each figure that was found wrong."""
    stamps = ("the scans' stamps", 1e3) if scans_late else ("the odometry's stamps", -1e3)
    units: list[tuple[str, float, str]] = [
        ("the scanner's x_m", 1.0, "m"),
        ("the scanner's y_m", 1.0, "m"),
        ("the scanner's yaw_deg", float(np.degrees(1)), "°"),
        (*stamps, "ms"),
    ]
    return [
        f"{what} off by {off * unit:.2f} ± {sigma * unit:.2f} {symbol}"
        for (what, unit, symbol), off, sigma, used in zip(units, fit.off, fit.sigma, fit.used, strict=True)
        if used
    ]
