"""Fusion: eq. (3), (4) against the textbook, the limits of a sure and a blind match, and what is refused."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from processing import geometry
from processing.fusion import consistent, fuse
from processing.odometry import Motions


def random_covariances(n: int, scale: float) -> np.ndarray:
    roots = np.random.default_rng(n).normal(0, scale, (n, 3, 3))
    return roots @ np.swapaxes(roots, -1, -2) + 1e-3 * scale**2 * np.eye(3)


@pytest.fixture
def odometry() -> Motions:
    deltas = np.random.default_rng(1).normal(0, 0.3, (40, 3))
    return Motions(deltas, random_covariances(40, 0.05))


def test_equals_the_information_form(odometry: Motions) -> None:
    matched = odometry.deltas + np.random.default_rng(2).normal(0, 0.05, (40, 3))
    covariances = random_covariances(40, 0.03)[::-1]
    fused = fuse(odometry, matched, covariances, np.ones(40, bool))
    a, b = np.linalg.inv(odometry.covariances), np.linalg.inv(covariances)
    expected = np.linalg.solve(a + b, a @ odometry.deltas[..., None] + b @ matched[..., None])[..., 0]
    assert_allclose(fused.deltas, expected, atol=1e-9)
    assert_allclose(fused.covariances, np.linalg.inv(a + b), rtol=1e-6, atol=1e-12)


def test_is_never_less_sure_than_either(odometry: Motions) -> None:
    covariances = random_covariances(40, 0.03)[::-1]
    fused = fuse(odometry, odometry.deltas, covariances, np.ones(40, bool))
    for larger in (odometry.covariances, covariances):
        assert np.linalg.eigvalsh(larger - fused.covariances).min() > -1e-12
    assert np.linalg.eigvalsh(fused.covariances).min() > 0
    assert_allclose(fused.covariances, np.swapaxes(fused.covariances, -1, -2), atol=1e-18)


def test_along_a_smooth_drift_the_wheels_decide() -> None:
    odometry = Motions(np.array([[0.2, 0.05, 0.01]]), np.diag([1e-4, 1e-4, 1e-5])[None])
    matched = np.array([[0.0, 0.0, 0.0]])
    fused = fuse(odometry, matched, np.diag([1e4, 1e-8, 1e-9])[None], np.array([True]))
    assert_allclose(fused.deltas[0], [0.2, 0.0, 0.0], atol=1e-5)


def test_a_refused_match_leaves_the_odometry_alone(odometry: Motions) -> None:
    matched = np.full((40, 3), np.nan)
    matched[::2] = odometry.deltas[::2] + 0.1
    covariances = random_covariances(40, 0.03)
    covariances[1::2] = np.nan
    accepted = np.arange(40) % 2 == 0
    fused = fuse(odometry, matched, covariances, accepted)
    assert_allclose(fused.deltas[1::2], odometry.deltas[1::2])
    assert_allclose(fused.covariances[1::2], odometry.covariances[1::2])
    assert np.abs(fused.deltas[::2] - odometry.deltas[::2]).min() > 0
    assert np.isfinite(fused.deltas).all()


def test_headings_on_both_sides_of_the_cut_meet_at_the_cut() -> None:
    odometry = Motions(np.array([[0.0, 0.0, np.pi - 0.1]]), np.eye(3)[None])
    fused = fuse(odometry, np.array([[0.0, 0.0, -np.pi + 0.1]]), np.eye(3)[None], np.array([True]))
    assert abs(geometry.wrap_angle(fused.deltas[0, 2] - np.pi)) < 1e-12


def test_no_step_at_all() -> None:
    fused = fuse(
        Motions(np.zeros((0, 3)), np.zeros((0, 3, 3))), np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0, bool)
    )
    assert fused.deltas.shape == (0, 3)


def test_gate_lets_through_what_the_covariances_promise() -> None:
    rng = np.random.default_rng(6)
    odometry = Motions(np.tile([0.3, 0.0, np.pi], (5000, 1)), np.tile(np.diag([4e-4, 1e-4, 1e-5]), (5000, 1, 1)))
    spread = np.sqrt([8e-4, 2e-4, 2e-5])
    matched = odometry.deltas + rng.normal(0, spread, (5000, 3))
    assert consistent(odometry, matched, odometry.covariances).mean() == pytest.approx(0.999, abs=0.001)
    assert not consistent(odometry, matched + np.array([0.3, 0, 0]), odometry.covariances).any()
