"""The vehicle's own parts are found in drives where the view changes, and walls are not taken for them."""

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest

from processing.own_parts import MIN_VIEWS, find_own_parts
from processing.simulation.raycast import SegmentGrid, build_grid, cast

ANGLES = np.radians(np.linspace(-135, 135, 361))
Ranges = np.ndarray  # (n, 361)


def ring(roughness_m: float) -> SegmentGrid:
    """A drift of 4 m width around a block of 30 × 16 m."""
    rng, lines = np.random.default_rng(4), []
    for off in (-2.0, 2.0):
        x, y = 15 + off, 8 + off
        corners = np.array([(-x, -y), (x, -y), (x, y), (-x, y), (-x, -y)])
        points = np.vstack([a + np.arange(0, 1, 0.02)[:, None] * (b - a) for a, b in pairwise(corners)])
        points = points + rng.normal(0, roughness_m, points.shape)
        lines.append(np.hstack([points, np.roll(points, -1, axis=0)]))
    return build_grid(np.vstack(lines))


def around(metres: float) -> np.ndarray:
    """Poses (n, 3) every 0.3 m along the middle of the ring's drift, turning on the spot at its corners."""
    corners = np.array([(-15, -8), (15, -8), (15, 8), (-15, 8)], float)
    poses = []
    for k in range(4):
        a, b = corners[k], corners[(k + 1) % 4]
        heading = k * np.pi / 2
        way = np.arange(0, np.hypot(*(b - a)), 0.3)
        poses += [(*(a + s * (b - a) / np.hypot(*(b - a))), heading) for s in way]
        poses += [(*b, heading + turn) for turn in np.arange(0.1, np.pi / 2, 0.1)]
    return np.array(poses)[: int(metres / 0.3)]


def look(walls: SegmentGrid, poses: np.ndarray) -> Ranges:
    noise = np.random.default_rng(5)
    seen = [cast(walls, np.tile(pose[:2], (len(ANGLES), 1)), pose[2] + ANGLES, 20.0) for pose in poses]
    return (np.array(seen) + noise.normal(0, 0.01, (len(poses), len(ANGLES)))).astype(np.float32)


@pytest.fixture(scope="module")
def rough() -> Ranges:
    return look(ring(0.1), around(120.0))


@pytest.fixture(scope="module")
def smooth() -> Ranges:
    return look(ring(0.0), around(120.0))


def put(ranges: Ranges, from_deg: float, to_deg: float, range_m: float) -> Ranges:
    """A part of the vehicle in view; where a wall is nearer it stays the wall."""
    rng, inside = np.random.default_rng(6), (np.degrees(ANGLES) >= from_deg) & (np.degrees(ANGLES) <= to_deg)
    part = range_m + rng.normal(0, 0.005, ranges.shape)
    return np.where(inside, np.minimum(ranges, part), ranges).astype(np.float32)


def in_dust(ranges: Ranges, share: float) -> Ranges:
    rng = np.random.default_rng(7)
    return np.where(rng.random(ranges.shape) < share, rng.uniform(0.1, np.fmin(ranges, 20.0)), ranges).astype(
        np.float32
    )


def bucket(ranges: Ranges) -> Ranges:
    return put(ranges, -15, 15, 1.5)


def post(ranges: Ranges) -> Ranges:
    return put(ranges, 39.7, 40.6, 1.2)


def close(ranges: Ranges) -> Ranges:
    return put(ranges, -40, -5, 0.3)


def in_dust_at_times(ranges: Ranges) -> Ranges:
    dusty = in_dust(bucket(ranges), 0.6)
    return np.where(np.arange(len(ranges))[:, None] // 50 % 3 == 0, dusty, bucket(ranges))


@pytest.mark.parametrize(
    ("change", "from_deg", "to_deg", "range_m"),
    [(bucket, -15, 15, 1.5), (post, 39.7, 40.6, 1.2), (close, -40, -5, 0.3), (in_dust_at_times, -15, 15, 1.5)],
)
def test_a_part_in_view_is_found_whole(
    rough: Ranges, smooth: Ranges, change: Callable[[Ranges], Ranges], from_deg: float, to_deg: float, range_m: float
) -> None:
    for drive in (rough, smooth) if change != in_dust_at_times else (rough,):  # few views must be clear ones
        (part,) = find_own_parts(change(drive), ANGLES)
        assert from_deg - 3 < np.degrees(part.from_rad) < from_deg
        assert to_deg < np.degrees(part.to_rad) < to_deg + 3
        assert np.isclose(part.range_m, range_m, atol=0.02)
        assert part.from_rad == ANGLES[part.first]
        assert part.to_rad == ANGLES[part.end - 1]


def test_two_parts_at_their_distances(rough: Ranges) -> None:
    found = find_own_parts(put(put(rough, -130, -120, 0.8), 50, 75, 1.1), ANGLES)
    assert [round(part.range_m, 1) for part in found] == [0.8, 1.1]
    assert str(found[0]) == "-131°…-119° see the vehicle itself at 0.8 m"


def test_walls_are_not_the_vehicles(rough: Ranges, smooth: Ranges) -> None:
    for drive in (rough, smooth, in_dust(rough, 0.6), in_dust(smooth, 0.6)):
        assert find_own_parts(drive, ANGLES) == []


def test_walls_that_a_straight_drive_holds_in_place_are_not_the_vehicles(smooth: Ranges) -> None:
    """Side walls of a smooth drift keep their distance for 30 m; only what is ahead changes."""
    straight = smooth[: int(28 / 0.3)]
    steady = np.ptp(straight, axis=0) < 0.1
    assert steady.sum() > 50
    assert find_own_parts(straight, ANGLES) == []


@pytest.mark.parametrize("share", [0.0, 0.2, 0.6])
def test_what_a_parked_vehicle_sees_is_not_its_own(rough: Ranges, share: float) -> None:
    """Twenty minutes in one place, with dust that falls, between two short moves."""
    noise = np.random.default_rng(8).normal(0, 0.01, (2000, len(ANGLES)))
    parked = np.vstack([rough[:100], rough[100] + noise, rough[100:200]]).astype(np.float32)
    assert find_own_parts(in_dust(parked, share), ANGLES) == []


def test_a_vehicle_that_drives_ahead_is_not_the_own(smooth: Ranges) -> None:
    """It keeps its distance to some decimetres."""
    ahead = np.degrees(np.abs(ANGLES)) < 12
    distance = 4 + 0.2 * np.sin(np.arange(len(smooth)) / 9)
    assert find_own_parts(np.where(ahead, np.minimum(smooth, distance[:, None]), smooth), ANGLES) == []


def test_too_few_views_tell_nothing(rough: Ranges) -> None:
    assert find_own_parts(bucket(rough)[: MIN_VIEWS - 1], ANGLES) == []
    assert find_own_parts(np.full((300, 361), np.nan, np.float32), ANGLES) == []
