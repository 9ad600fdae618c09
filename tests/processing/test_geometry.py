"""SE(2) properties on random poses: group laws, analytic against numeric Jacobians, alignment."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from processing import geometry as g


@pytest.fixture
def poses() -> np.ndarray:
    rng = np.random.default_rng(1)
    return np.column_stack([rng.normal(0, 10, (200, 2)), rng.uniform(-np.pi, np.pi, 200)])


def same(a: np.ndarray, b: np.ndarray) -> None:
    assert_allclose(a[..., :2], b[..., :2], atol=1e-9)
    assert_allclose(g.wrap_angle(a[..., 2] - b[..., 2]), 0, atol=1e-9)


def test_wrap_angle_lies_in_half_open_range() -> None:
    angles = np.array([0, np.pi, -np.pi, 3 * np.pi, -3.5 * np.pi, 100.0])
    wrapped = g.wrap_angle(angles)
    assert np.all((wrapped > -np.pi) & (wrapped <= np.pi))
    assert_allclose(np.exp(1j * wrapped), np.exp(1j * angles), atol=1e-12)


def test_group_laws(poses: np.ndarray) -> None:
    a, b = poses[:100], poses[100:]
    c = np.roll(a, 7, axis=0)
    same(g.compose(a, g.inverse(a)), np.zeros_like(a))
    same(g.compose(a, g.relative(a, b)), b)
    same(g.relative(a, b), g.compose(g.inverse(a), b))
    same(g.compose(g.compose(a, b), c), g.compose(a, g.compose(b, c)))


@pytest.mark.parametrize(
    ("function", "jacobians"), [(g.compose, g.compose_jacobians), (g.relative, g.relative_jacobians)]
)
def test_jacobians_equal_their_numeric_twins(function, jacobians, poses: np.ndarray) -> None:
    a, b = poses[0], poses[1]
    for which, analytic in enumerate(jacobians(a, b)):
        for k in range(3):
            step = np.zeros(3)
            step[k] = 1e-6
            plus = function(a + step, b) if which == 0 else function(a, b + step)
            minus = function(a - step, b) if which == 0 else function(a, b - step)
            assert_allclose(analytic[:, k], (plus - minus) / 2e-6, atol=1e-6)


def test_accumulate_is_repeated_composition(poses: np.ndarray) -> None:
    chain = [poses[0]]
    for motion in poses[1:20]:
        chain.append(g.compose(chain[-1], motion))
    same(g.accumulate(poses[0], poses[1:20]), np.array(chain))


def test_align_finds_the_transform(poses: np.ndarray) -> None:
    points = np.random.default_rng(2).normal(0, 5, (50, 2))
    same(g.align(points, g.transform(poses[3], points)), poses[3])


def test_poses_between_samples_turn_the_short_way() -> None:
    times, poses = np.array([0.0, 1.0, 2.0]), np.array([[0, 0, 3.0], [2, 4, -3.0], [2, 4, -2.0]], float)
    between = g.interpolate_poses(times, poses, np.array([-1.0, 0.5, 1.25, 9.0]))
    turn = 2 * np.pi - 6
    expected = [[0, 0, 3.0], [1, 2, 3 + turn / 2], [2, 4, -2.75], [2, 4, -2.0]]
    assert_allclose(between[:, :2], np.array(expected)[:, :2])
    assert_allclose(g.wrap_angle(between[:, 2] - np.array(expected)[:, 2]), 0, atol=1e-12)
