"""Walls of a scan of which beams are missing, or met dust: as those of the whole scan, wherever there are returns."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from processing.geometry import compose, wrap_angle
from processing.scan_matching import match_scans
from processing.scan_walls import Scan, prepare_scan
from processing.simulation.raycast import build_grid, cast

ANGLES = np.radians(np.linspace(-135, 135, 541))
REACH_M = 20.0
STORED_NORMALS = [  # of five beams of the room, before walls went on across missing beams
    [0.30919573094440894, 0.9509984226936198],
    [0.5267880423541441, 0.8499966814245151],
    [-0.8990062141572224, 0.43793587076956614],
    [-0.4033663260186551, -0.9150385822653666],
    [-0.39355982296090614, -0.9192990078048493],
]
STORED_VARIANCES = [
    [0.0006244820902668207, 0.0026280417512577997],
    [0.00035620204579121334, 0.0019788437280154033],
    [0.0004204444504259862, 0.002251093489313012],
    [0.00046707136268923325, 0.0031362394273676372],
    [0.0005553278545024606, 0.0026306583295176373],
]
Loss = Callable[[np.ndarray, np.random.Generator], np.ndarray]


def corridor(width_m: float) -> np.ndarray:
    """Two walls along x, 120 m long."""
    return np.array([[-60.0, y, 60.0, y] for y in (-width_m / 2, width_m / 2)])


def room() -> np.ndarray:
    """10 × 7 m with a block in it."""
    corners = np.array([(-5, -3), (5, -3), (5, 2), (2.5, 2), (2.5, 4), (-5, 4), (-5, -3)], float)
    block = np.array([(1, -1.6), (2, -1.2), (1.7, -0.4), (1, -1.6)])
    return np.vstack([np.hstack([line[:-1], line[1:]]) for line in (corners, block)])


def look(walls: np.ndarray, pose: np.ndarray, noise: np.random.Generator, noise_m: float = 0.012) -> np.ndarray:
    """Ranges (541,) from there; NaN beyond REACH_M."""
    ranges = cast(build_grid(walls), np.tile(pose[:2], (len(ANGLES), 1)), pose[2] + ANGLES, REACH_M)
    return np.where(np.isfinite(ranges), ranges + noise.normal(0, noise_m, len(ranges)), np.nan)


def points_of(ranges: np.ndarray) -> np.ndarray:
    return np.column_stack([ranges * np.cos(ANGLES), ranges * np.sin(ANGLES)])


def scan_of(ranges: np.ndarray) -> Scan:
    return prepare_scan(points_of(ranges), ANGLES[0], ANGLES[1] - ANGLES[0])


def half(ranges: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return np.where(rng.random(len(ranges)) < 0.5, np.nan, ranges)


def third(ranges: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return np.where(rng.random(len(ranges)) < 0.7, np.nan, ranges)


def every_second(ranges: np.ndarray, _: np.random.Generator) -> np.ndarray:
    return np.where(np.arange(len(ranges)) % 2, np.nan, ranges)


def sectors(ranges: np.ndarray, _: np.random.Generator) -> np.ndarray:
    return np.where(np.abs(np.sin(3 * ANGLES)) > 0.8, np.nan, ranges)


def dust(ranges: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return np.where(rng.random(len(ranges)) < 0.3, rng.uniform(0.3, np.nan_to_num(ranges, nan=REACH_M)), ranges)


def cloud(ranges: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A clump of 60 beams wide, 1 to 2 m off."""
    first = int(rng.integers(0, len(ranges) - 60))
    hit = (rng.random(len(ranges)) < 0.7) & (np.arange(len(ranges)) // 60 == first // 60)
    return np.where(hit, np.fmin(rng.uniform(1, 2, len(ranges)), ranges), ranges)


def test_walls_of_a_whole_scan_are_as_they_always_were() -> None:
    scan = scan_of(look(room(), np.array([-1.0, 0.3, 0.4]), np.random.default_rng(1), 0.03))
    beams = [40, 100, 250, 330, 430]
    assert_allclose(scan.normals[beams], STORED_NORMALS, atol=1e-9)
    assert_allclose(scan.variances[beams], STORED_VARIANCES, rtol=1e-6)


@pytest.mark.parametrize("lose", [half, third, every_second, sectors, dust, cloud])
def test_a_wall_goes_on_behind_beams_that_say_nothing(lose: Loss) -> None:
    """Its direction is known about as well as the variances say, and nearly each return is of a wall."""
    for seed in range(5):
        rng = np.random.default_rng(seed)
        whole = look(corridor(4.6), np.array([0.0, 0.3, 0.0]), rng)
        ranges = lose(whole, rng)
        scan = scan_of(ranges)
        true = np.isfinite(ranges) & (ranges == whole)
        walls = true & np.isfinite(scan.normals[:, 0])
        assert walls.sum() > 0.85 * true.sum()
        off = np.arctan(scan.normals[walls, 0] / scan.normals[walls, 1]) / np.sqrt(scan.variances[walls, 1])
        assert np.sqrt(np.mean(np.clip(off, -5, 5) ** 2)) < 2.5
        assert (np.isfinite(scan.normals[:, 0]) & ~true).sum() < 0.1 * true.sum()


@pytest.mark.parametrize("lose", [half, third, every_second, sectors, dust, cloud])
def test_motions_are_found_between_scans_that_lost_beams(lose: Loss) -> None:
    start = np.array([-1.0, 0.3, 0.4])
    for seed in range(5):
        rng = np.random.default_rng(seed)
        motion = rng.uniform(-1, 1, 3) * [0.5, 0.5, 0.2]
        first, second = (scan_of(lose(look(room(), at, rng), rng)) for at in (start, compose(start, motion)))
        found = match_scans(first, second, motion + rng.uniform(-1, 1, 3) * [0.1, 0.1, 0.05])
        assert found.converged
        assert found.inliers > 0.9
        assert np.hypot(*(found.motion - motion)[:2]) < 0.03
        assert abs(wrap_angle(found.motion[2] - motion[2])) < 0.004


def test_the_far_ends_of_two_walls_are_not_one_wall() -> None:
    """Twenty metres down a narrow drift, the few beams between its walls have no return."""
    ranges = look(corridor(2.5), np.zeros(3), np.random.default_rng(3))
    between = np.isnan(ranges)
    assert 0 < between.sum() < 40
    scan = scan_of(ranges)
    fitted = np.isfinite(scan.normals[:, 0])
    assert_allclose(np.abs(scan.normals[fitted, 1]), 1, atol=0.02)


def test_less_noise_makes_surer_walls() -> None:
    ranges = look(corridor(4.6), np.zeros(3), np.random.default_rng(5))
    points = points_of(ranges)
    usual, surer = (
        prepare_scan(points, ANGLES[0], ANGLES[1] - ANGLES[0], **noise) for noise in ({}, {"range_noise_m": 0.003})
    )
    assert surer.range_noise_m == 0.003
    assert np.nanmin(surer.variances[:, 0]) < np.nanmin(usual.variances[:, 0])
    assert_array_equal(np.nanmin(usual.variances[:, 0]), usual.range_noise_m**2)
