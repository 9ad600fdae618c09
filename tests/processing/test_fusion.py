"""Fusion: eq. (3), (4) against the textbook, the limits of a sure and a blind match, and what is refused."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from processing.fusion import fuse
from processing.geometry import wrap_angle


def random_covariance(rng: np.random.Generator, scale: float) -> np.ndarray:
    root = rng.normal(0, scale, (3, 3))
    return root @ root.T + 1e-3 * scale**2 * np.eye(3)


@pytest.fixture(params=range(20))
def rng(request: pytest.FixtureRequest) -> np.random.Generator:
    return np.random.default_rng(request.param)


def test_equals_the_information_form(rng: np.random.Generator) -> None:
    expected, prior, doubt = rng.normal(0, 0.3, 3), random_covariance(rng, 0.05), random_covariance(rng, 0.03)
    matched = expected + rng.normal(0, 0.05, 3)
    _, fused, covariance = fuse(expected, prior, 9.0, matched, doubt)
    a, b = np.linalg.inv(prior), np.linalg.inv(doubt)
    assert_allclose(fused, np.linalg.solve(a + b, a @ expected + b @ matched), atol=1e-9)
    assert_allclose(covariance, np.linalg.inv(a + b), rtol=1e-6, atol=1e-12)


def test_is_never_less_sure_than_either(rng: np.random.Generator) -> None:
    expected, prior, doubt = rng.normal(0, 0.3, 3), random_covariance(rng, 0.05), random_covariance(rng, 0.03)
    agrees, _, covariance = fuse(expected, prior, 1.0, expected, doubt)
    assert agrees
    for larger in (prior, doubt):
        assert np.linalg.eigvalsh(larger - covariance).min() > -1e-12
    assert np.linalg.eigvalsh(covariance).min() > 0
    assert_allclose(covariance, covariance.T, atol=1e-18)


def test_along_a_smooth_drift_the_wheels_decide() -> None:
    prior, doubt = np.diag([1e-4, 1e-4, 1e-5]), np.diag([1e4, 1e-8, 1e-9])
    _, fused, _ = fuse(np.array([0.2, 0.05, 0.01]), prior, 1.0, np.zeros(3), doubt)
    assert_allclose(fused, [0.2, 0.0, 0.0], atol=1e-5)


def test_headings_on_both_sides_of_the_cut_meet_at_the_cut() -> None:
    before, after = np.array([0.0, 0.0, np.pi - 0.1]), np.array([0.0, 0.0, -np.pi + 0.1])
    agrees, fused, _ = fuse(before, 0.01 * np.eye(3), 1.0, after, 0.01 * np.eye(3))
    assert agrees
    assert abs(wrap_angle(fused[2] - np.pi)) < 1e-12


@pytest.mark.parametrize(("gate", "share"), [(1.0, 0.999), (9.0, 1.0)])
def test_the_gate_lets_through_what_the_covariances_promise(gate: float, share: float) -> None:
    rng = np.random.default_rng(6)
    expected, covariance = np.array([0.3, 0.0, np.pi]), np.diag([4e-4, 1e-4, 1e-5])
    matched = expected + rng.normal(0, np.sqrt([8e-4, 2e-4, 2e-5]), (5000, 3))
    assert np.mean([fuse(expected, covariance, gate, of, covariance)[0] for of in matched]) == pytest.approx(
        share, abs=0.001
    )
    astray = matched + np.array([0.3 * np.sqrt(gate), 0, 0])
    assert not any(fuse(expected, covariance, gate, of, covariance)[0] for of in astray)
