"""The compiled step against the plain functions that it stands in for."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from processing.chain_step import carry, invert, join, to_laser, to_vehicle
from processing.geometry import compose, compose_jacobians, inverse, wrap_angle
from processing.scan_match import through_mount


def random_pose(rng: np.random.Generator) -> np.ndarray:
    return rng.uniform(-3, 3, 3)


def random_covariance(rng: np.random.Generator) -> np.ndarray:
    root = rng.normal(size=(3, 3)) * [0.1, 0.05, 0.02]
    return root @ root.T + 1e-6 * np.eye(3)


@pytest.fixture(params=range(20))
def rng(request: pytest.FixtureRequest) -> np.random.Generator:
    return np.random.default_rng(request.param)


def test_poses_and_their_covariances_are_carried_on(rng: np.random.Generator) -> None:
    pose, step, covariance, noise = random_pose(rng), random_pose(rng), random_covariance(rng), random_covariance(rng)
    j_pose, j_step = compose_jacobians(pose, step)
    carried, grown = carry(pose, covariance, step, noise)
    assert_allclose(carried, compose(pose, step), atol=1e-12)
    assert_allclose(join(pose, step), compose(pose, step), atol=1e-12)
    assert_allclose(invert(pose), inverse(pose), atol=1e-12)
    assert_allclose(grown, j_pose @ covariance @ j_pose.T + j_step @ noise @ j_step.T, atol=1e-12)


def test_motions_pass_through_the_mount_both_ways(rng: np.random.Generator) -> None:
    mount, motion, covariance = random_pose(rng), random_pose(rng), random_covariance(rng)
    expected, spread = through_mount(mount, motion, covariance)
    moved, grown = to_vehicle(mount, mount, motion, covariance)
    assert_allclose(moved[:2], expected[:2], atol=1e-12)
    assert_allclose(wrap_angle(moved[2] - expected[2]), 0, atol=1e-12)
    assert_allclose(grown, spread, atol=1e-12)
    back = to_laser(mount, mount, moved)
    assert_allclose(back[:2], motion[:2], atol=1e-12)
    assert_allclose(wrap_angle(back[2] - motion[2]), 0, atol=1e-12)


def test_motions_pass_from_one_vehicle_to_another(rng: np.random.Generator) -> None:
    first, second, motion, covariance = (*(random_pose(rng) for _ in range(3)), random_covariance(rng))
    moved, grown = to_vehicle(first, second, motion, covariance)
    expected = compose(compose(first, motion), inverse(second))
    assert_allclose(moved[:2], expected[:2], atol=1e-12)
    assert_allclose(wrap_angle(to_laser(first, second, moved) - motion)[2], 0, atol=1e-12)
    assert_allclose(to_laser(first, second, moved)[:2], motion[:2], atol=1e-12)
    _, j_motion = compose_jacobians(first, motion)
    j_both, _ = compose_jacobians(compose(first, motion), inverse(second))
    assert_allclose(grown, j_both @ j_motion @ covariance @ j_motion.T @ j_both.T, atol=1e-12)
