"""Polar scan matching on rooms and drifts whose answer is known, and on real scans whose relations are."""

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from hw_profiles.profile import OdometryNoise
from processing import geometry, odometry
from processing.import_carmen import parse_lines
from processing.polar_matching import _project, match_polar
from processing.polar_scan import filter_ranges, fit_normals, label_surfaces, ranges_at
from processing.relations import read_relations, relation_errors

REAL = Path("../shared/data/carmen")
LMS111 = np.radians(np.arange(-135, 135.1, 0.5))  # 541 beams
STILL = np.zeros(3)


def polyline(*points: tuple[float, float]) -> np.ndarray:
    """Walls (S, 4) along the points."""
    return np.hstack([points[:-1], points[1:]])


ROOM = np.vstack(
    [
        polyline((-4, -3), (5, -3), (5, 2), (3, 2), (3, 4), (-4, 4), (-4, -3)),
        polyline((1.0, -1.5), (1.6, -1.5), (1.6, -1.0), (1.0, -1.0), (1.0, -1.5)),
    ]
)


def drift(roughness_m: float) -> np.ndarray:
    """Two walls, 3 m apart and 160 m long."""
    rng, x = np.random.default_rng(7), np.arange(-80, 80, 0.25)
    walls = []
    for side in (-1.5, 1.5):
        y = side + np.convolve(rng.normal(0, roughness_m, len(x)), [0.4, 0.8, 0.4], mode="same")
        walls.append(polyline(*zip(x, y, strict=True)))
    return np.vstack(walls)


def scan(walls: np.ndarray, pose: np.ndarray, angles: np.ndarray = LMS111, reach: float = 20.0) -> np.ndarray:
    """Ranges (B,) of a perfect laser; +inf beyond its reach."""
    u = np.stack([np.cos(angles + pose[2]), np.sin(angles + pose[2])], axis=-1)[:, None, :]
    start, along = walls[:, :2] - pose[:2], walls[:, 2:] - walls[:, :2]

    def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]

    with np.errstate(divide="ignore", invalid="ignore"):
        ranges, part = cross(start, along) / cross(u, along), cross(start, u) / cross(u, along)
    ranges[~((ranges > 0) & (part >= 0) & (part <= 1))] = np.inf
    nearest = ranges.min(axis=1)
    return np.where(nearest < reach, nearest, np.inf)


def assert_found(match, motion: np.ndarray, metres: float, degrees: float) -> None:
    assert match.converged
    assert np.hypot(*(match.motion - motion)[:2]) < metres
    assert abs(np.degrees(geometry.wrap_angle(match.motion[2] - motion[2]))) < degrees


def random_motions(n: int, spread_m: float, spread_deg: float) -> np.ndarray:
    return np.random.default_rng(8).normal(0, [spread_m, spread_m, np.radians(spread_deg)], (n, 3))


def test_a_scan_lies_on_itself() -> None:
    ranges = scan(ROOM, STILL)
    match = match_polar(ranges, ranges, LMS111, STILL)
    assert_found(match, STILL, 1e-6, 1e-4)
    assert match.inliers > 0.99
    assert match.residual_m < 1e-6


@pytest.mark.parametrize("start", [(0.0, 0.0, 0.0), (-1.0, 1.5, 2.5), (2.0, 0.5, -1.2)])
def test_known_motion_without_noise(start: tuple[float, float, float]) -> None:
    for motion in random_motions(15, 0.15, 5):
        reference, current = scan(ROOM, np.array(start)), scan(ROOM, geometry.compose(np.array(start), motion))
        assert_found(match_polar(reference, current, LMS111, STILL), motion, 0.005, 0.1)


@pytest.mark.parametrize(
    ("first_deg", "last_deg", "beams"),
    [(-90, 90, 181), (-90, 90, 90), (-135, 135, 1082), (0, 270, 541), (-119, 119, 340)],
)
def test_any_laser(first_deg: float, last_deg: float, beams: int) -> None:
    angles = np.radians(np.linspace(first_deg, last_deg, beams))
    start, motion = np.array([0.0, 0.0, -np.radians((first_deg + last_deg) / 2)]), np.array([0.12, -0.06, 0.07])
    reference, current = scan(ROOM, start, angles), scan(ROOM, geometry.compose(start, motion), angles)
    assert_found(match_polar(reference, current, angles, STILL), motion, 0.01, 0.25)


def test_a_large_turn_is_found_within_the_search_and_beyond_it_with_a_guess() -> None:
    for turn_deg, guess_deg in [(17, 0), (-17, 0), (170, 160), (-100, -90)]:
        motion = np.array([0.05, 0.02, np.radians(turn_deg)])
        match = match_polar(scan(ROOM, STILL), scan(ROOM, motion), LMS111, np.array([0, 0, np.radians(guess_deg)]))
        assert_found(match, motion, 0.005, 0.1)


def test_noise_stays_within_what_the_covariance_says() -> None:
    """Normalised squared errors average to 3 if the covariance is right, to less if it is cautious."""
    rng, normalised = np.random.default_rng(9), []
    for walls in (ROOM, drift(0.15), drift(0.05)):
        for motion in random_motions(40, 0.1, 3):
            start = np.array([*rng.uniform(-0.5, 0.5, 2), 0.0])
            reference = scan(walls, start) + rng.normal(0, 0.012, 541)
            current = scan(walls, geometry.compose(start, motion)) + rng.normal(0, 0.012, 541)
            match = match_polar(reference, current, LMS111, STILL)
            error = match.motion - motion
            normalised.append(error @ np.linalg.solve(match.covariance, error))
            assert match.converged
            assert np.sqrt(match.covariance[1, 1]) < 0.01  # across the drift it is sure, and says so
    assert 0.3 < np.mean(normalised) < 3
    assert np.max(normalised) < 16


@pytest.mark.parametrize("noise_m", [0.0, 0.01, 0.03])
def test_along_a_smooth_drift_the_motion_is_open(noise_m: float) -> None:
    rng, walls = np.random.default_rng(10), drift(0.0)
    heading = np.array([0, 0, 0.1])
    for motion in random_motions(10, 0.1, 3):
        reference = scan(walls, heading) + noise_m * rng.normal(0, 1, 541)
        current = scan(walls, geometry.compose(heading, motion)) + noise_m * rng.normal(0, 1, 541)
        match = match_polar(reference, current, LMS111, STILL)
        drift_axes = geometry.rotation(-heading[2])  # columns: along the drift and across it, in the reference's frame
        covariance = drift_axes.T @ match.covariance[:2, :2] @ drift_axes
        assert match.converged
        assert covariance[0, 0] > 1.0
        assert covariance[1, 1] < covariance[0, 0] / 1e3
        across = drift_axes[:, 1] @ (match.motion - motion)[:2]
        assert abs(across) < 0.005 + noise_m / 3
        assert abs(np.degrees(match.motion[2] - motion[2])) < 0.2


def test_rough_walls_show_the_motion_along_the_drift() -> None:
    walls, motion = drift(0.1), np.array([0.2, 0.01, 0.01])
    match = match_polar(scan(walls, STILL), scan(walls, motion), LMS111, STILL)
    assert_found(match, motion, 0.005, 0.1)
    assert np.sqrt(match.covariance[0, 0]) < 0.02


def test_outliers_and_missing_beams() -> None:
    rng = np.random.default_rng(11)
    for motion in random_motions(10, 0.1, 3):
        reference, current = scan(ROOM, STILL), scan(ROOM, motion)
        for ranges in (reference, current):
            ranges[rng.choice(541, 27, replace=False)] = rng.uniform(0.1, 20, 27)  # dust
            ranges[rng.choice(541, 27, replace=False)] = np.inf
            ranges[rng.choice(541, 27, replace=False)] = np.nan
        current[200:240] = 0.7  # someone steps in
        assert_found(match_polar(reference, current, LMS111, STILL), motion, 0.01, 0.15)


def test_has_no_handedness() -> None:
    """The mirrored scans give the mirrored motion: else a long drive would bend to one side."""
    mirror = np.array([1.0, -1.0, -1.0])
    for motion in random_motions(10, 0.2, 3):
        reference, current = scan(drift(0.15), STILL), scan(drift(0.15), motion)
        match = match_polar(reference, current, LMS111, STILL)
        mirrored = match_polar(reference[::-1].copy(), current[::-1].copy(), LMS111, STILL)
        assert_allclose(mirrored.motion * mirror, match.motion, atol=1e-9)


def test_what_hides_behind_a_corner_does_not_pull() -> None:
    """A wing wall hides a niche from the first place and not from the second."""
    walls = np.vstack([ROOM, polyline((1.5, 2.0), (3.0, 2.0))])
    motion = np.array([0.3, 0.3, 0.1])
    assert_found(match_polar(scan(walls, STILL), scan(walls, motion), LMS111, STILL), motion, 0.01, 0.15)


def test_projection_hides_what_stands_behind_and_what_shows_its_back() -> None:
    """A laser at x = 2 sees a panel at x = 1 from ahead; the origin looks at its back, before a far wall."""
    walls = np.vstack([polyline((1.0, -0.5), (1.0, 0.5)), polyline((5.0, -9.0), (5.0, 9.0))])
    pose, increment = np.array([2.0, 0.3, 1.7]), LMS111[1] - LMS111[0]
    ranges = filter_ranges(scan(walls, pose))
    labels = label_surfaces(ranges, increment)
    projected = _project(ranges, labels, np.cos(LMS111), np.sin(LMS111), increment, pose)
    behind_panel = np.abs(LMS111) < np.arctan(0.4)
    beside_panel = (np.degrees(LMS111) > 31) & (np.degrees(LMS111) < 50)
    assert (projected[behind_panel] == 0).all()
    assert_allclose(projected[beside_panel], 5 / np.cos(LMS111[beside_panel]), rtol=1e-9)


def test_inliers_are_of_what_both_can_see_and_overlap_is_of_all() -> None:
    """Round a corner: the current scan sees a room that the reference only sees the door of."""
    walls = np.vstack([polyline((-6, -1), (1, -1), (1, -6), (9, -6), (9, 1), (-6, 1)), polyline((-6, -1), (-6, 1))])
    motion = np.array([1.4, -0.3, -0.3])
    match = match_polar(scan(walls, STILL), scan(walls, motion), LMS111, motion)
    assert_found(match, motion, 0.01, 0.2)
    assert match.inliers > 0.9
    assert match.overlap < 0.8


@pytest.mark.parametrize("empty", [np.inf, np.nan, 0.0, -1.0])
def test_nothing_seen_is_no_match(empty: float) -> None:
    guess = np.array([0.1, 0.0, 0.05])
    match = match_polar(np.full(541, empty), scan(ROOM, STILL), LMS111, guess)
    assert not match.converged
    assert match.inliers == 0
    assert_allclose(match.motion, guess)
    assert np.sqrt(np.diag(match.covariance)).min() > 1


def test_different_places_do_not_match_well() -> None:
    match = match_polar(scan(ROOM, STILL), scan(drift(0.1), STILL), LMS111, STILL)
    assert not match.converged or match.inliers < 0.4


def test_median_keeps_steps_and_drops_spikes() -> None:
    ranges = np.repeat([2.0, 5.0], 20)
    ranges[[5, 6, 30]] = [9.0, 9.0, np.nan]
    filtered = filter_ranges(ranges)
    assert_allclose(filtered[:20], 2.0)
    assert filtered[30] == 0
    assert_allclose(np.delete(filtered[20:], 10), 5.0)


def test_surfaces_break_at_steps_and_hold_along_grazing_walls() -> None:
    bearings = np.radians(np.arange(2, 90, 0.5))
    wall = 1.0 / np.sin(bearings)  # ahead it recedes by up to 5 m from one beam to the next
    assert len(set(label_surfaces(wall, np.radians(0.5)))) == 1
    labels = label_surfaces(np.array([2.0] * 5 + [4.0] * 5 + [9.0] + [4.0] * 5 + [0.0] + [4.0] * 2), np.radians(0.5))
    assert labels[10] == 0  # alone
    assert not labels[16:].any()
    assert len({labels[0], labels[5], labels[11]}) == 3


def test_normals_are_those_of_the_walls() -> None:
    ranges = scan(ROOM, STILL)
    increment = LMS111[1] - LMS111[0]
    normals = fit_normals(ranges, label_surfaces(ranges, increment), np.cos(LMS111), np.sin(LMS111), increment)
    ahead = np.abs(LMS111) < np.radians(10)
    assert_allclose(normals[ahead, :2], np.tile([1.0, 0.0], (ahead.sum(), 1)), atol=1e-6)


@pytest.mark.skipif(not REAL.exists(), reason="the real logs in ../shared/data/carmen are not here")
def test_real_scans_in_a_row_beat_the_odometry() -> None:
    """Intel Research Lab: relations checked by hand within the densely recorded first quarter."""
    lines = [line for line in parse_lines(REAL / "intel-merged-raw.log.gz", {}) if line.ranges_m is not None][:2000]
    stamps, poses = np.array([line.stamp_ns for line in lines]), np.array([line.odometry for line in lines])
    ranges = np.array([line.ranges_m for line in lines], float)
    ranges[ranges >= 80] = np.inf
    angles = np.radians(np.arange(180.0) - 90)
    deltas = odometry.odom_motions(poses, OdometryNoise()).deltas
    matches = [match_polar(*pair, angles, guess) for *pair, guess in zip(ranges[:-1], ranges[1:], deltas, strict=True)]
    assert np.mean([match.converged for match in matches]) > 0.95
    matched = geometry.accumulate(poses[0], np.array([match.motion for match in matches]))
    relations = read_relations(REAL / "intel.relations")
    inside = (relations.start_ns < stamps.max()) & (relations.end_ns < stamps.max())
    relations = type(relations)(relations.start_ns[inside], relations.end_ns[inside], relations.poses[inside])
    raw = relation_errors(stamps, poses, relations, stamps, poses)
    found = relation_errors(stamps, matched, relations, stamps, poses)
    assert found.translation_mean_m < raw.translation_mean_m / 3
    assert found.rotation_mean_deg < raw.rotation_mean_deg / 3


def test_a_sweep_made_on_the_way_is_told_at_even_bearings() -> None:
    """At 4 m/s every beam starts from elsewhere; taken for ranges at their bearings, the points turn every match."""
    way = np.zeros((len(LMS111), 3))
    way[:, 0] = 4.0 * 0.02 / 720 * np.arange(len(LMS111))  # 50 Hz: 20 ms a turn
    ranges = np.array([scan(drift(0.0), pose, LMS111[k : k + 1])[0] for k, pose in enumerate(way)])
    ranges[np.isinf(ranges)] = np.nan
    points = ranges[:, None] * np.column_stack([np.cos(LMS111), np.sin(LMS111)]) + way[:, :2]
    still, found = scan(drift(0.0), STILL), ranges_at(LMS111, points)
    both = np.isfinite(found) & np.isfinite(still) & (still < 15)
    assert both.sum() > 0.95 * (still < 15).sum()
    assert_allclose(found[both], still[both], atol=2e-3)
    assert np.abs(np.hypot(*points.T) - still)[both].max() > 0.03  # as it would be taken for
    assert np.isnan(ranges_at(LMS111, np.full((len(LMS111), 2), np.nan))).all()
    matched = match_polar(found, still, LMS111, STILL)
    assert abs(matched.motion[2]) < 1e-4
    assert abs(matched.motion[1]) < 5e-4
