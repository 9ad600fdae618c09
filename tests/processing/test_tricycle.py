"""Steering, wheel, wheelbase and mount of a tricycle: found from far off, with made drives and with a real one.

The real one lies beside the repository, in ../shared; where it does not, its tests are skipped.
"""

from pathlib import Path

import numpy as np
import pytest
from recorded_tricycle import (
    DEVICE_COUNTS,
    FIRST_GUESS,
    Recording,
    calibrate_tricycle,
    count_on,
    deviations,
    read_tricycle,
    with_lost_turns,
)

from processing.geometry import compose, relative
from processing.steering_calibration import (
    GEAR,
    MOUNT,
    NAMES,
    RADIUS,
    WHEELBASE,
    ZERO,
    Drive,
    SteeringFit,
    base_poses,
    fit_steering,
)

REAL = Path(__file__).parents[3] / "shared" / "data" / "tricycle" / "dataset.txt"
needs_recording = pytest.mark.skipif(not REAL.is_file(), reason=f"{REAL} is not there: a real tricycle's drive")

TRUE = np.array([0.5, np.radians(5), 0.3, 1.5, 1.7, 0.2, np.radians(10)])
GUESS = np.array([0.1, 0.0, 0.28, 1.8, 1.5, 0.0, 0.0])  # gear five times off, wheelbase 20 %
UNKNOWN = np.array([np.inf, 0.2, 0.1, 0.5, 0.5, 0.5, 0.3])
NOISE = np.array([0.004, 0.004, 0.002])  # m, m, rad


def make_drive(
    axle: str, most_rad: float, seed: int, shakes_deg: float = 0.5, seconds: float = 120.0
) -> tuple[Drive, Drive]:
    """As it was, and as encoders of 5,000 and 8,192 counts tell it, of a wheel that slips and a steering that shakes.

    It winds forwards and then back, steered by up to `most_rad`.
    """
    rng, times = np.random.default_rng(seed), np.arange(0.0, seconds, 0.05)
    knots = np.arange(0.0, seconds + 4, 4.0)
    steered = most_rad * np.interp(times, knots, rng.uniform(-1, 1, len(knots)))
    steps = np.where(times < 0.7 * seconds, 0.5, -0.5) * 0.05 / TRUE[RADIUS]
    slipped = steps * (1 + 0.1 * rng.standard_normal(len(times)))
    shaken = steered + np.radians(shakes_deg) * rng.standard_normal(len(times))
    true, told = (
        np.column_stack([np.cumsum(rolled), (angle - TRUE[ZERO]) / TRUE[GEAR]])
        for rolled, angle in ((steps, steered), (slipped, shaken))
    )
    counts = np.round(told / (2 * np.pi) * np.array([5000, 8192]))
    counted = counts * 2 * np.pi / np.array([5000, 8192])
    which = "front" if axle == "front" else "rear"
    return Drive(times, true, which), Drive(times, counted, which)


def fit_made(
    drive: tuple[Drive, Drive], seed: int, guess: np.ndarray, prior: np.ndarray, outliers: int = 0
) -> SteeringFit:
    true, told = drive
    rng, firsts = np.random.default_rng(seed), np.arange(0, len(true.times) - 40, 20)
    ends_s = true.times[np.column_stack([firsts, firsts + 40])]
    poses = compose(base_poses(true, TRUE, ends_s.ravel()), TRUE[MOUNT]).reshape(-1, 2, 3)
    motions = relative(poses[:, 0], poses[:, 1]) + NOISE * rng.standard_normal((len(firsts), 3))
    motions[:outliers] += rng.choice([-0.5, 0.4], (outliers, 3))
    return fit_steering(told, ends_s, motions, np.tile(np.diag(NOISE**2), (len(firsts), 1, 1)), guess, prior)


@pytest.mark.parametrize("axle", ["front", "rear"])
@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("times", [0.2, 5.0])
def test_a_tricycle_is_found_from_far_off(axle: str, seed: int, times: float) -> None:
    guess = np.where(np.arange(len(NAMES)) == GEAR, times * TRUE, GUESS)
    fit = fit_made(make_drive(axle, 0.9, seed), seed, guess, UNKNOWN, outliers=12)
    assert np.all(np.abs(fit.value - TRUE) < 3 * fit.sigma)
    assert np.all(fit.sigma < [0.03, 0.01, 0.005, 0.1, 0.03, 0.03, 0.01])


def test_its_doubt_is_that_of_many_drives() -> None:
    """Pairs that overlap are counted with care, so the doubt may be ample; it is never too small."""
    fits = [fit_made(make_drive("front", 0.9, seed), seed, TRUE, UNKNOWN) for seed in range(10, 22)]
    scatter = np.sqrt(np.mean([(fit.value - TRUE) ** 2 for fit in fits], axis=0))
    assert np.all(scatter < 1.6 * fits[0].sigma)
    assert np.all(scatter > 0.1 * fits[0].sigma)


def test_a_steering_that_shakes_makes_no_wheelbase_long() -> None:
    """What shakes looks smaller by a longer wheelbase."""
    prior = np.array([0.0, 0.1, 0.1, 0.5, 0.0, 0.0, 0.0])
    fits = [fit_made(make_drive("rear", 0.2, seed, shakes_deg=5.0), seed, TRUE, prior) for seed in range(20)]
    assert abs(np.mean([fit.value[WHEELBASE] for fit in fits]) / TRUE[WHEELBASE] - 1) < 0.01


def test_of_little_steering_gear_and_wheelbase_are_known_by_their_ratio_only() -> None:
    fit = fit_made(make_drive("rear", 0.1, 4), 4, TRUE, UNKNOWN)
    shared = fit.covariance[GEAR, WHEELBASE] / fit.sigma[GEAR] / fit.sigma[WHEELBASE]
    assert shared > 0.95
    share = np.zeros(len(NAMES))
    share[GEAR], share[WHEELBASE] = 1 / fit.value[GEAR], -1 / fit.value[WHEELBASE]
    ratio_sigma = np.sqrt(share @ fit.covariance @ share)
    assert ratio_sigma < 0.3 * fit.sigma[WHEELBASE] / fit.value[WHEELBASE]
    ratio = fit.value[GEAR] / fit.value[WHEELBASE] / (TRUE[GEAR] / TRUE[WHEELBASE])
    assert abs(ratio - 1) < 3 * ratio_sigma


def test_what_is_held_stays_and_nothing_seen_leaves_the_prior() -> None:
    prior = np.where(np.arange(len(NAMES)) == ZERO, 0.03, 0.0)
    drive, _ = make_drive("front", 0.9, 5)
    fit = fit_steering(drive, np.zeros((0, 2)), np.zeros((0, 3)), np.zeros((0, 3, 3)), GUESS, prior)
    assert fit.value == pytest.approx(GUESS)
    assert fit.sigma == pytest.approx(prior)


def test_counts_go_on_where_their_uint32_wraps() -> None:
    counts = np.array([2**32 - 300, 2**32 - 1, 299, 2**32 - 101], np.uint32)
    assert count_on(counts).tolist() == [0, 299, 599, 199]


@pytest.mark.parametrize("way", [1, -1])
def test_what_a_16_bit_counter_lost_in_a_pause_is_counted(way: int) -> None:
    times = 0.04 * np.arange(200)
    true = way * 6600 * np.arange(200)
    late = true.copy()
    late[80:87] = true[80]  # a pause of seven records
    lost = late.copy()
    lost[87:] -= way * DEVICE_COUNTS
    assert np.array_equal(with_lost_turns(times, lost), late)
    assert np.array_equal(with_lost_turns(times, late), late)


@pytest.fixture(scope="module")
def real() -> Recording:
    return read_tricycle(REAL)


@needs_recording
def test_the_real_tricycle_is_found_alike_by_both_halves_of_its_drive(real: Recording) -> None:
    half = len(real) // 2
    first, second = calibrate_tricycle(real.cut(0, half)), calibrate_tricycle(real.cut(half, len(real)))
    assert np.all(np.abs(first.value - second.value) < 3 * np.hypot(first.sigma, second.sigma))
    assert 0.53 < first.value[GEAR] < 0.59
    assert -4.5 < np.degrees(first.value[ZERO]) < -2.5
    assert first.sigma[GEAR] < 0.015


@needs_recording
def test_the_calibrated_real_tricycle_reckons_many_times_better_than_by_its_first_guess(real: Recording) -> None:
    half = len(real) // 2
    fit = calibrate_tricycle(real.cut(0, half))
    for part, most_m, most_deg, times_better in ((real.cut(half, len(real)), 0.3, 6.0, 15), (real, 0.3, 5.0, 20)):
        by_guess, found = deviations(part, FIRST_GUESS), deviations(part, fit.value)
        guess_m, found_m = (np.sqrt(np.mean(np.sum(off[:, :2] ** 2, axis=1))) for off in (by_guess, found))
        guess_rad, found_rad = (np.sqrt(np.mean(off[:, 2] ** 2)) for off in (by_guess, found))
        assert found_m < min(most_m, guess_m / times_better)
        assert found_rad < min(np.radians(most_deg), guess_rad / times_better)


@needs_recording
def test_the_counts_of_the_real_tricycle_neither_wrap_nor_jump(real: Recording) -> None:
    counted = real.drive.wheels[:, 0] / (2 * np.pi) * 5000
    assert np.abs(np.diff(counted)).max() < DEVICE_COUNTS
    assert 5.8e6 < counted[-1] < 6.0e6  # 5,650,996 in the file, and four times 65,536 that were lost
