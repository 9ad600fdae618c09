"""What strong links may claim: links between drives must not pretend to see along a smooth drift."""

import numpy as np
from numpy.testing import assert_allclose

from processing.scan_matching import UNSEEN_VARIANCE
from processing.strong_links import blur, extreme_variances


def unseen_along(tilt_rad: float, turn_per_m: float) -> np.ndarray:
    """The covariance (3, 3) of a match that leaves open one direction: nearly along the drift."""
    along = np.array([np.cos(tilt_rad), np.sin(tilt_rad), turn_per_m])
    return np.diag([0.0, 0.003**2, 0.0005**2]) + UNSEEN_VARIANCE * np.outer(along, along)


def test_many_links_of_a_smooth_drift_do_not_add_up_to_seeing_along_it() -> None:
    rng = np.random.default_rng(7)
    matches = [unseen_along(*rng.normal(0, [0.002, 0.002])) + 1e-9 * np.eye(3) for _ in range(400)]

    def sigma_along(covariances: list[np.ndarray]) -> float:
        return float(np.linalg.inv(sum(np.linalg.inv(c) for c in covariances))[0, 0] ** 0.5)

    assert sigma_along(matches) < 0.05  # as the matches stand, they would fix the way to centimetres
    assert sigma_along([blur(match) for match in matches]) > 0.3


def test_a_match_that_sees_every_direction_is_taken_at_its_word() -> None:
    covariance = np.diag([0.01**2, 0.003**2, 0.0005**2])
    assert_allclose(blur(covariance), covariance)


def test_extreme_variances_are_eigenvalues() -> None:
    for k in range(20):
        root = np.random.default_rng(k).normal(size=(3, 3)) * [10.0 ** (k % 5 - 2), 0.1, 0.01]
        covariance = root @ root.T
        expected = np.linalg.eigvalsh(covariance[:2, :2])
        np.testing.assert_allclose(extreme_variances(covariance), expected, rtol=1e-6, atol=1e-9 * expected[1])
