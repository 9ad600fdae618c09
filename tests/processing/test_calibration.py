"""Calibration: the wheels' error is found where the walls show it, and left alone where they do not."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from processing.calibration import (
    LEAST_NOISE,
    MAX_SIGMA,
    PRIOR,
    Pairs,
    calibrate,
    compare_strides,
    cut_strides,
    fit_scale,
    join_pairs,
    scale_of,
    stride_pairs,
)
from processing.calibration import (
    pairs_of as as_motions,
)
from processing.pipeline import DrivenRun
from processing.read_log import Run


def pairs_of(run: Run) -> Pairs:
    return as_motions(run, join_pairs([compare_strides(strides) for strides in cut_strides(run)]))


def test_the_small_mine_shows_that_its_wheels_count_too_little(driven: list[DrivenRun]) -> None:
    for of in driven:  # its world has wheels that are 1.0 and 0.8 % larger than the profile says
        assert of.wheels.scale == pytest.approx(1.009, abs=0.002)
        assert of.wheels.sigma < 0.001
        assert scale_of(pairs_of(of.run)).scale == pytest.approx(
            1.0, abs=0.001
        )  # put right, nothing is left to put right


def test_perfect_wheels_stay_as_they_are(driven_clean: list[DrivenRun]) -> None:
    for of in driven_clean:
        assert of.wheels.scale == pytest.approx(1.0, abs=0.0005)


def test_too_little_seen_changes_nothing(driven: list[DrivenRun], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("processing.calibration.MIN_INLIERS", 1.1)  # as if no match were good enough
    run, wheels = calibrate(driven[0].run, pairs_of(driven[0].run))
    assert run.wheels is not None
    assert driven[0].run.wheels is not None
    assert_allclose(run.wheels, driven[0].run.wheels)
    assert run.profile == driven[0].run.profile
    assert (wheels.scale, wheels.pairs) == (1.0, 0)
    assert wheels.sigma == pytest.approx(PRIOR)
    assert wheels.sigma > MAX_SIGMA


def test_fit_is_not_bent_by_matches_that_jumped() -> None:
    rng = np.random.default_rng(5)
    counted = rng.uniform(2, 4, 300)
    variances = np.full(300, 0.01**2)
    seen = 1.013 * counted + rng.normal(0, 0.01, 300)
    seen[::5] += rng.choice([-0.4, 0.4, 0.8], 60)  # a fifth of them
    fitted = fit_scale(counted, seen, variances)
    assert fitted.scale == pytest.approx(1.013, abs=0.001)
    assert 0.0001 < fitted.sigma < 0.0008
    assert 0.01 / 2 < fitted.noise_m_per_sqrt_m < 0.01  # 0.01 m in 2 to 4 m


def test_the_noise_of_the_wheels_is_what_was_seen_within_reason(driven: list[DrivenRun]) -> None:
    for of in driven:
        assert of.run.profile.vehicle is not None
        ours = of.run.profile.vehicle.odometry_noise.distance_m_per_sqrt_m
        assert LEAST_NOISE * 0.02 <= ours < 0.012  # the profile says 0.02, its world 0.004
        assert ours == pytest.approx(max(of.wheels.noise_m_per_sqrt_m, LEAST_NOISE * 0.02))


def test_pairs_lie_their_stride_apart_all_along_the_way() -> None:
    way = np.cumsum(np.random.default_rng(6).uniform(0, 0.4, 2000))
    pairs = np.array(stride_pairs(way))
    apart = way[pairs[:, 1]] - way[pairs[:, 0]]
    assert np.all((apart >= 2.0) & (apart < 4.5))
    assert np.ptp(way[pairs[:, 0]]) > 0.95 * np.ptp(way)
    assert len(stride_pairs(np.zeros(50))) == 0  # a vehicle that stood still


@pytest.mark.parametrize("slip_m_per_sqrt_m", [0.0, 0.01, 0.03])
def test_wheels_that_slip_are_known_less_well(slip_m_per_sqrt_m: float) -> None:
    """The stated deviation of the scale covers its error, over many short drives on one piece of rough ground."""
    rng, off = np.random.default_rng(6), []
    for _ in range(200):
        way = np.arange(0.0, 40.0, 0.1)
        true = 1.01 * way + np.append(0.0, np.cumsum(rng.normal(0, slip_m_per_sqrt_m * np.sqrt(0.1), len(way) - 1)))
        ends = stride_pairs(way)
        seen = np.diff(true[ends])[:, 0] + rng.normal(0, 0.012, len(ends))
        found = fit_scale(np.diff(way[ends])[:, 0], seen, np.full(len(ends), 0.012**2))
        off.append((found.scale - 1.01) / found.sigma)
    assert 0.4 < np.mean(np.square(off)) < 1.6
