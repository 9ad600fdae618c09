"""The way of a motion from the laser to the vehicle and back."""

import numpy as np
from numpy.testing import assert_allclose

from processing import geometry
from processing.scan_match import through_mount

MOUNT = np.array([-0.6, 0.2, np.radians(170)])
MOTION, COVARIANCE = np.array([0.4, -0.1, 0.3]), np.diag([1e-4, 4e-4, 1e-5])


def test_laser_moves_as_the_vehicle_that_carries_it() -> None:
    start, vehicle = np.array([5.0, 6.0, 1.0]), np.array([0.5, 0.0, 0.2])
    before = geometry.compose(start, MOUNT)
    after = geometry.compose(geometry.compose(start, vehicle), MOUNT)
    found, _ = through_mount(MOUNT, geometry.relative(before, after), np.zeros((3, 3)))
    assert_allclose(found, vehicle, atol=1e-12)


def test_covariance_is_that_of_samples() -> None:
    samples = np.random.default_rng(1).multivariate_normal(MOTION, COVARIANCE, 100_000)
    _, covariance = through_mount(MOUNT, MOTION, COVARIANCE)
    sampled = np.cov(through_mount(MOUNT, samples, np.zeros((100_000, 3, 3)))[0].T)
    scale = np.sqrt(np.outer(np.diag(sampled), np.diag(sampled)))
    assert_allclose(covariance / scale, sampled / scale, atol=0.02)


def test_there_and_back_over_a_batch() -> None:
    motions, covariances = np.tile(MOTION, (4, 1)), np.tile(COVARIANCE, (4, 1, 1))
    there = through_mount(MOUNT, motions, covariances)
    back = through_mount(geometry.inverse(MOUNT), *there)
    assert_allclose(back[0], motions, atol=1e-12)
    assert_allclose(back[1], covariances, atol=1e-15)
