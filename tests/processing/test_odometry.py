"""Odometry against the geometry of an arc, Euler's step, the plain unscented transform and sampled noise."""

import subprocess
import sys

import numpy as np
import pytest
from numpy.testing import assert_allclose

from hw_profiles.profile import OdometryNoise, Profile, load_profile, parse_profile
from processing import geometry, odometry

NOISE = OdometryNoise()


@pytest.fixture
def trailer() -> Profile:
    return load_profile("canmet_trailer")


def tricycle(axle: str) -> Profile:
    return parse_profile(
        f"""
        schema = 1
        name = "three_wheels"
        vehicle = {{ kinematics = "tricycle", wheelbase_m = 2.0, drive_axle = "{axle}" }}
        [[encoders]]
        name = "drive"
        role = "drive_wheel"
        wheel_radius_m = 0.25
        [[encoders]]
        name = "steering"
        role = "steering"
        """,
        source="test",
    )


def test_two_wheels_drive_a_quarter_circle_exactly(trailer: Profile) -> None:
    radius, track, wheel = 5.0, 1.6, 0.35
    turn = np.linspace(0, np.pi / 2, 4)
    left, right = turn * (radius - track / 2) / wheel, turn * (radius + track / 2) / wheel
    poses = odometry.dead_reckon(odometry.wheel_motions(trailer, left, right))
    assert_allclose(poses[-1], [radius, radius, np.pi / 2], atol=1e-12)


@pytest.mark.parametrize("axle", ["rear", "front"])
def test_tricycle_turns_about_the_point_where_the_axles_meet(axle: str) -> None:
    steering, turn = 0.4, np.pi / 2
    rear_radius = 2.0 / np.tan(steering)
    driven = rear_radius if axle == "rear" else 2.0 / np.sin(steering)
    angles = np.linspace(0, turn, 10) * driven / 0.25
    poses = odometry.dead_reckon(odometry.wheel_motions(tricycle(axle), angles, np.full(10, steering)))
    assert_allclose(poses[-1], [rear_radius, rear_radius, turn], atol=1e-9)


def test_tricycle_takes_the_steering_between_its_samples() -> None:
    profile = tricycle("rear")
    _, turns = odometry.wheel_steps(profile, np.array([0.0, 4.0]), np.array([0.0, 0.2]))
    assert_allclose(turns, 1.0 * np.tan(0.1) / 2.0)


def test_a_missing_tick_moves_the_end_nowhere(trailer: Profile) -> None:
    left, right = np.arange(11) * 0.5, np.arange(11) * 0.6
    whole = odometry.dead_reckon(odometry.wheel_motions(trailer, left, right))
    holes = odometry.dead_reckon(odometry.wheel_motions(trailer, left[[0, 1, 5, 10]], right[[0, 1, 5, 10]]))
    assert_allclose(holes[-1], whole[-1], atol=1e-12)


def test_euler_step_of_the_paper_agrees_at_small_steps(trailer: Profile) -> None:
    """Eq. (1) falls short of the arc by half the turn of a step: the gap shrinks as the steps do."""
    gaps = []
    for n in (10, 100, 1000):
        turn = np.linspace(0, 1.0, n + 1)
        left, right = turn * 4.2 / 0.35, turn * 5.8 / 0.35
        distance, turned = odometry.wheel_steps(trailer, left, right)
        euler = geometry.accumulate(np.zeros(3), np.column_stack([distance, np.zeros(n), turned]))
        exact = odometry.dead_reckon(odometry.wheel_motions(trailer, left, right))
        gaps.append(np.linalg.norm(euler[-1, :2] - exact[-1, :2]))
    assert gaps[2] < 3e-3
    assert_allclose(np.array(gaps[:2]) / gaps[1:], 10, rtol=0.05)


def random_steps(n: int) -> np.ndarray:
    rng = np.random.default_rng(3)
    return np.column_stack([rng.normal(0.3, 0.5, n), rng.normal(0, 0.2, n), np.zeros(n)])


def test_batch_covariance_is_the_unscented_transform() -> None:
    steps = random_steps(50)
    motions = odometry.odom_motions(geometry.accumulate(np.zeros(3), odometry.arc(steps)), NOISE)
    variances = odometry.input_variances(steps, NOISE)
    for step, variance, delta, covariance in zip(steps, variances, motions.deltas, motions.covariances, strict=True):
        mean, plain = odometry.unscented_motion(np.zeros(3), 1e-24 * np.eye(3), step, variance)
        assert_allclose(delta, mean, atol=1e-4)
        assert_allclose(covariance, plain, rtol=1e-7, atol=1e-14)


def test_augmented_state_carries_the_uncertainty_of_the_start() -> None:
    pose, start = np.array([3.0, -2.0, 2.5]), np.diag([0.01, 0.02, 0.001])
    step = np.array([[0.5, 0.1, 0.0]])
    variances = odometry.input_variances(step, NOISE)[0]
    mean, covariance = odometry.unscented_motion(pose, start, step[0], variances)
    motion = odometry.odom_motions(np.array([np.zeros(3), odometry.arc(step)[0]]), NOISE)
    j_pose, j_motion = geometry.compose_jacobians(pose, motion.deltas[0])
    assert_allclose(mean, geometry.compose(pose, motion.deltas[0]), atol=1e-3)
    assert_allclose(covariance, j_pose @ start @ j_pose.T + j_motion @ motion.covariances[0] @ j_motion.T, atol=2e-6)


def test_covariance_is_that_of_sampled_noise() -> None:
    step = np.array([[2.0, 0.4, 0.0]])
    deviations = np.sqrt(odometry.input_variances(step, NOISE)[0])
    samples = odometry.arc(step + np.random.default_rng(4).normal(0, deviations, (200_000, 3)))
    motions = odometry.odom_motions(np.array([np.zeros(3), odometry.arc(step)[0]]), NOISE)
    sampled = np.cov(samples.T)
    scale = np.sqrt(np.outer(np.diag(sampled), np.diag(sampled)))
    assert_allclose(motions.covariances[0] / scale, sampled / scale, atol=0.01)


def test_many_small_steps_doubt_as_much_as_few_large_ones() -> None:
    """Noise belongs to the metres driven, not to the rate of the samples."""

    def end_covariance(n: int) -> np.ndarray:
        steps = np.tile([8.0 / n, 1.0 / n, 0.0], (n, 1))
        motions = odometry.odom_motions(geometry.accumulate(np.zeros(3), odometry.arc(steps)), NOISE)
        pose, covariance = np.zeros(3), np.zeros((3, 3))
        for delta, added in zip(motions.deltas, motions.covariances, strict=True):
            j_pose, j_motion = geometry.compose_jacobians(pose, delta)
            covariance = j_pose @ covariance @ j_pose.T + j_motion @ added @ j_motion.T
            pose = geometry.compose(pose, delta)
        return covariance

    assert_allclose(np.diag(end_covariance(400)), np.diag(end_covariance(50)), rtol=0.05)


def test_standing_still_is_nearly_sure_and_still_positive_definite(trailer: Profile) -> None:
    motions = odometry.wheel_motions(trailer, np.full(5, 7.0), np.full(5, 9.0))
    assert np.all(motions.deltas == 0)
    assert_allclose(np.sqrt(np.diagonal(motions.covariances, axis1=1, axis2=2)), [[1e-4, 1e-4, 2e-5]] * 4, rtol=1e-6)
    np.linalg.cholesky(motions.covariances)


def test_odom_motions_lead_through_the_poses_they_came_from() -> None:
    rng = np.random.default_rng(5)
    poses = np.column_stack([rng.normal(0, 3, (30, 2)), rng.uniform(-3, 3, 30)])
    motions = odometry.odom_motions(poses, NOISE)
    chain = odometry.dead_reckon(motions, poses[0])
    assert_allclose(chain[:, :2], poses[:, :2], atol=1e-9)
    assert_allclose(geometry.wrap_angle(chain[:, 2] - poses[:, 2]), 0, atol=1e-9)
    np.linalg.cholesky(motions.covariances)


def test_importing_odometry_leaves_filterpy_alone() -> None:
    code = "import sys, processing.odometry; sys.exit('filterpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
