"""What strong links may claim: links between drives must not pretend to see along a smooth drift."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from processing.scan_matching import UNSEEN_VARIANCE, match_scans
from processing.strong_links import (
    FIRST_DRIVES,
    MOST_LOOPS,
    VIEW_M,
    KeyFrames,
    blur,
    extreme_variances,
    facing,
    loop_pairs,
)


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


OUT = np.column_stack([np.arange(0, 30, 0.5), np.zeros(60), np.zeros(60)])
BACK = np.column_stack([np.arange(30, 0, -0.5), np.full(60, 0.3), np.full(60, np.pi)])


@pytest.mark.parametrize("ahead_m", [1.5, -0.6])
def test_drives_both_ways_are_matched_where_their_scanners_face_each_other(ahead_m: float) -> None:
    """Scanners that look away from each other see no wall in common, above all in a narrow drift."""
    mount = np.array([ahead_m, 0.0, 0.0 if ahead_m > 0 else np.pi])
    looks = np.sign(ahead_m)
    frames = KeyFrames(
        [], np.repeat([0, 1], 60), np.tile(np.arange(0, 30, 0.5), 2), np.tile(mount, (120, 1)), match_scans
    )
    pairs = loop_pairs(frames, np.vstack([OUT, BACK]), np.arange(60, 120), np.arange(60), 1.0)
    assert len(pairs) > 30
    scanners = OUT[pairs[:, 0], 0] + ahead_m, BACK[pairs[:, 1] - 60, 0] - ahead_m
    assert_allclose(looks * (scanners[1] - scanners[0])[1:-1], 2 * VIEW_M, atol=0.51)
    i, k = facing(OUT, 30, BACK, 30, (mount, mount))
    assert_allclose(looks * (BACK[k, 0] - ahead_m - OUT[i, 0] - ahead_m), 2 * VIEW_M, atol=0.51)


def test_drives_the_same_way_are_matched_side_by_side() -> None:
    beside = OUT + np.array([0.2, 0.5, 0.01])
    assert facing(OUT, 30, beside, 30, (np.array([1.5, 0.0, 0.0]), np.array([1.5, 0.0, 0.0]))) == (30, 30)


def test_of_many_drives_the_nearest_of_the_first_are_matched() -> None:
    beside_m = np.array([0.9, 0.1, 0.5, 0.3, 0.7, 0.2, 0.8, 0.4])
    drives = [OUT + np.array([0.0, y, 0.0]) for y in beside_m]
    frames = KeyFrames(
        [], np.repeat(np.arange(9), 60), np.tile(np.arange(0, 30, 0.5), 9), np.zeros((540, 3)), match_scans
    )
    pairs = loop_pairs(frames, np.vstack([*drives, OUT]), np.arange(480, 540), np.arange(480), 2.5)
    nearest = set(np.argsort(beside_m[:FIRST_DRIVES])[:MOST_LOOPS].tolist())
    for new in range(480, 540):
        olds = pairs[pairs[:, 1] == new, 0]
        assert set((olds // 60).tolist()) == nearest
        assert_allclose(olds % 60, new - 480)  # side by side
