"""Point-to-line matching in drifts and rooms whose answer is known: what it finds, and what it admits not to see."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.testing import assert_allclose

from processing.geometry import compose, inverse, rotation, wrap_angle
from processing.match_search import score, search_match
from processing.scan_match import ScanMatch
from processing.scan_matching import UNSEEN_VARIANCE, match_scans
from processing.scan_walls import Scan, prepare_scan
from processing.simulation.raycast import SegmentGrid, build_grid, cast
from processing.simulation.walls import periodic_noise

LMS111 = np.radians(np.linspace(-135, 135, 541))
NOISE_M = 0.012
STEP_M = 0.1


def polyline(points: np.ndarray) -> np.ndarray:
    return np.hstack([points[:-1], points[1:]])


@cache
def drift(roughness_m: float, seed: int = 0, niche: bool = False) -> SegmentGrid:
    """Two walls along x, 4.6 m apart and 120 m long; the niche is 2 m wide and lies ahead on the left."""
    rng, x, walls = np.random.default_rng(seed), np.arange(-60, 60, STEP_M), []
    for side in (-2.3, 2.3):
        y = np.full(len(x), side)
        if roughness_m:
            y = y + roughness_m * periodic_noise(len(x), STEP_M, 1.5, rng)
        if niche and side > 0:
            y = y + 1.5 * ((x > 3) & (x < 5))
        walls.append(polyline(np.column_stack([x, y])))
    return build_grid(np.vstack(walls))


@cache
def room() -> SegmentGrid:
    """10 × 7 m, with an alcove and a block; no symmetry."""
    corners = [(-5, -3), (5, -3), (5, 2), (2.5, 2), (2.5, 4), (-5, 4), (-5, -3)]
    block = [(1, -1.6), (2, -1.2), (1.7, -0.4), (1, -1.6)]
    return build_grid(np.vstack([polyline(np.array(corners, float)), polyline(np.array(block, float))]))


def look(
    walls: SegmentGrid, pose: np.ndarray, noise: np.random.Generator | None = None, angles: np.ndarray = LMS111
) -> Scan:
    """What a laser at `pose` sees."""
    ranges = cast(walls, np.tile(pose[:2], (len(angles), 1)), pose[2] + angles, 20.0)
    if noise is not None:
        ranges = ranges + noise.normal(0, NOISE_M, len(ranges))
    ranges[~np.isfinite(ranges)] = np.nan
    points = np.column_stack([ranges * np.cos(angles), ranges * np.sin(angles)])
    return prepare_scan(points, angles[0], angles[1] - angles[0])


def assert_found(found: ScanMatch, motion: np.ndarray, metres: float, radians: float) -> None:
    assert found.converged
    assert np.hypot(*(found.motion - motion)[:2]) < metres
    assert abs(wrap_angle(found.motion[2] - motion[2])) < radians


def deviation(found: ScanMatch, direction: np.ndarray) -> float:
    return float(np.sqrt(direction @ found.covariance[:2, :2] @ direction))


def random_motions(count: int, metres: float, radians: float) -> np.ndarray:
    return np.random.default_rng(11).uniform(-1, 1, (count, 3)) * [metres, metres, radians]


@pytest.mark.parametrize("walls", [room(), drift(0.2)], ids=["room", "rough drift"])
def test_known_motions_are_found_to_millimetres(walls: SegmentGrid) -> None:
    start, rng = np.array([-1.0, 0.3, 0.4]), np.random.default_rng(1)
    reference, noisy = look(walls, start), look(walls, start, rng)
    for motion in random_motions(20, 0.7, 0.3):
        guess = motion + rng.uniform(-1, 1, 3) * [0.2, 0.2, 0.1]
        end = compose(start, motion)
        assert_found(match_scans(reference, look(walls, end), guess), motion, 0.004, 0.001)
        found = match_scans(noisy, look(walls, end, rng), guess)
        assert_found(found, motion, 0.02, 0.002)
        assert found.inliers > 0.9
        assert found.residual_m < 0.05


def test_a_scan_lies_on_itself() -> None:
    scan = look(room(), np.array([0.5, 0.5, 1.0]), np.random.default_rng(2))
    found = match_scans(scan, scan, np.zeros(3))
    assert_found(found, np.zeros(3), 1e-4, 1e-5)
    assert found.inliers == 1
    assert found.overlap == 1


def test_the_way_back_is_the_inverse_of_the_way_there() -> None:
    rng, a, motion = np.random.default_rng(3), np.array([-2.0, 0.4, 0.2]), np.array([0.8, -0.2, 0.25])
    first, second = look(drift(0.2), a, rng), look(drift(0.2), compose(a, motion), rng)
    there, back = match_scans(first, second, motion), match_scans(second, first, inverse(motion))
    assert_found(back, inverse(there.motion), 0.01, 1e-3)


def test_a_frame_turned_within_the_scanner_turns_the_answer_alone() -> None:
    """The same beams, called by other bearings: the motion and its covariance turn along, and nothing else changes."""
    rng, a, motion, turn = np.random.default_rng(4), np.array([0.0, 0.3, 0.2]), np.array([0.5, 0.1, 0.15]), 0.8
    first, second = (look(drift(0.2), pose, rng) for pose in (a, compose(a, motion)))

    def turned(scan: Scan) -> Scan:
        return prepare_scan(scan.points @ rotation(turn).T, scan.angle_min + turn, scan.angle_increment)

    guess = motion + np.array([0.1, -0.05, 0.03])
    plain = match_scans(first, second, guess)
    other = match_scans(turned(first), turned(second), np.array([*rotation(turn) @ guess[:2], guess[2]]))
    spin = np.eye(3)
    spin[:2, :2] = rotation(turn)
    assert_allclose(other.motion, spin @ plain.motion, atol=1e-4)
    assert_allclose(other.covariance, spin @ plain.covariance @ spin.T, rtol=0.05, atol=1e-7)
    assert other.inliers == pytest.approx(plain.inliers, abs=0.01)


@pytest.mark.parametrize("error_m", [-0.3, -0.05, 0.05, 0.3])
def test_a_smooth_drift_leaves_the_motion_along_it_to_the_guess(error_m: float) -> None:
    """Normals fitted to noisy points pretend to see the motion along, and would say "you did not move": the mean over
    many scans must keep the guess's error as it is, while across and heading are found.
    """
    start, motion = np.array([0.0, 0.2, 0.05]), np.array([0.5, 0.03, 0.04])
    along, across = rotation(-0.05).T
    errors = []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        reference, current = look(drift(0.0), start, rng), look(drift(0.0), compose(start, motion), rng)
        found = match_scans(reference, current, motion + np.array([*error_m * along, 0.0]))
        assert found.converged
        assert deviation(found, along) > 10
        with_wheels = replace(found, covariance=np.linalg.inv(np.linalg.inv(found.covariance) + np.eye(3) / 0.1**2))
        assert deviation(with_wheels, along) > 0.099
        assert deviation(with_wheels, across) < 0.004
        assert np.sqrt(with_wheels.covariance[2, 2]) < 0.002
        error = found.motion - motion
        errors.append([along @ error[:2], across @ error[:2], error[2]])
    assert abs(np.mean(errors, axis=0)[0] - error_m) < 0.1 * abs(error_m)
    assert np.abs(np.array(errors)[:, 0] - error_m).max() < 0.2 * abs(error_m)
    assert np.abs(np.array(errors)[:, 1]).max() < 0.005
    assert np.abs(np.array(errors)[:, 2]).max() < 0.001


@pytest.mark.parametrize(
    ("roughness_m", "least_m", "most_m"), [(0.0, 10, 1000), (0.01, 0.1, 1000), (0.04, 0, 0.2), (0.1, 0, 0.03)]
)
def test_between_smooth_and_rough_the_covariance_says_which(roughness_m: float, least_m: float, most_m: float) -> None:
    """What the match claims to see of the motion along the drift, it sees."""
    start, motion, along = np.array([0.0, 0.2, 0.0]), np.array([0.5, 0.03, 0.04]), np.array([1.0, 0.0])
    deviations = []
    for seed in range(15):
        rng, walls = np.random.default_rng(seed), drift(roughness_m, seed)
        reference, current = look(walls, start, rng), look(walls, compose(start, motion), rng)
        found = match_scans(reference, current, motion + np.array([0.1, 0, 0]))
        if found.converged:
            assert abs(found.motion[0] - motion[0]) < 4 * deviation(found, along)
            deviations.append(deviation(found, along))
    assert len(deviations) > 10
    assert least_m < np.median(deviations) < most_m


@pytest.mark.parametrize("error_m", [-0.3, -0.1, 0.1, 0.3])
def test_one_niche_shows_the_motion_along_a_smooth_drift(error_m: float) -> None:
    """Two dozen beams among five hundred; a guess further off than their noise must not make them outliers."""
    for x in (-2.0, 0.0, 1.0):
        start, motion, rng = np.array([x, 0.2, 0.1]), np.array([0.5, 0.03, 0.04]), np.random.default_rng(5)
        walls, guess = drift(0.0, niche=True), motion + np.array([error_m, 0, 0])
        found = match_scans(look(walls, start, rng), look(walls, compose(start, motion), rng), guess)
        assert_found(found, motion, 0.03, 0.002)
        assert deviation(found, np.array([1.0, 0.0])) < 0.02


def test_errors_are_as_large_as_the_covariance_says() -> None:
    """NEES over drifts, noise and motions: 3 if the covariance is right. It may say twice, never half, the error."""
    squares = []
    for seed in range(60):
        rng, walls = np.random.default_rng(seed), drift(0.2, seed % 6)
        start = rng.uniform([-30, -0.5, -3], [30, 0.5, 3])
        motion = rng.uniform(-1, 1, 3) * [0.8, 0.3, 0.3]
        guess = motion + rng.uniform(-1, 1, 3) * [0.1, 0.1, 0.05]
        found = match_scans(look(walls, start, rng), look(walls, compose(start, motion), rng), guess)
        if found.converged:
            error = found.motion - motion
            squares.append(error @ np.linalg.solve(found.covariance, error))
    assert len(squares) > 50
    assert 0.3 < np.mean(squares) < 4
    assert np.max(squares) < 25


@pytest.mark.parametrize("walls", [room(), drift(0.2)], ids=["room", "rough drift"])
def test_scans_that_face_each_other_match_on_the_half_they_share(walls: SegmentGrid) -> None:
    rng, start, motion = np.random.default_rng(6), np.array([0.0, 0.2, 0.1]), np.array([0.6, -0.3, np.pi - 0.15])
    guess = motion + np.array([0.15, 0.1, 0.1])
    found = match_scans(look(walls, start, rng), look(walls, compose(start, motion), rng), guess)
    assert_found(found, motion, 0.02, 0.003)
    assert found.overlap < 0.9 < found.inliers  # what the other cannot see does not speak against it


def test_beams_without_a_return_do_not_count() -> None:
    rng, start, motion = np.random.default_rng(7), np.array([-1.0, 0.5, 0.4]), np.array([0.4, 0.2, -0.2])
    full = look(room(), start, rng), look(room(), compose(start, motion), rng)
    holed = []
    for scan in full:
        points = scan.points.copy()
        points[rng.random(len(points)) < 0.1] = np.nan
        points[100:180] = np.nan
        holed.append(prepare_scan(points, scan.angle_min, scan.angle_increment))
    assert_found(match_scans(*holed, motion + np.array([0.1, 0.1, 0.05])), motion, 0.02, 0.003)


def test_scanners_of_different_make_match() -> None:
    """541 beams over 270° against 181 over 180°."""
    start, motion = np.array([-1.0, 0.5, 0.4]), np.array([0.4, 0.2, -0.2])
    sick = look(room(), compose(start, motion), angles=np.radians(np.arange(-90.0, 91.0)))
    assert_found(match_scans(look(room(), start), sick, motion + np.array([0.1, 0.1, 0.05])), motion, 0.01, 0.003)
    back = match_scans(sick, look(room(), start), inverse(motion) + np.array([0.1, 0.1, 0.05]))
    assert_found(back, inverse(motion), 0.01, 0.003)


def test_too_little_in_common_keeps_the_guess_and_says_so() -> None:
    reference, guess = look(room(), np.zeros(3)), np.array([0.1, -0.2, 0.3])
    few = np.full((541, 2), np.nan)
    few[200:208] = reference.points[200:208]
    nothing, far = np.full((541, 2), np.nan), reference.points + 40.0
    for points in (nothing, few, far):
        found = match_scans(reference, prepare_scan(points, LMS111[0], np.radians(0.5)), guess)
        assert not found.converged
        assert np.all(found.motion == guess)
        assert np.all(np.linalg.eigvalsh(found.covariance) >= UNSEEN_VARIANCE * 0.999)
        assert score(found) == -np.inf
    empty = prepare_scan(nothing, LMS111[0], np.radians(0.5))
    assert not match_scans(empty, reference, guess).converged
    assert not search_match(empty, reference, guess, 1.0, 0.2).converged


def test_another_place_is_no_match() -> None:
    """A drift's scan in a room: whatever is found, few of the points that should be there are."""
    found = search_match(look(room(), np.zeros(3)), look(drift(0.2), np.zeros(3)), np.zeros(3), 1.0, 0.3)
    assert not found.converged or found.inliers < 0.7


def test_search_finds_from_far_off() -> None:
    rng, start = np.random.default_rng(8), np.array([-2.0, 0.3, 0.4])
    reference = look(room(), start, rng)
    for motion in random_motions(6, 1.0, 0.3):
        bearing = rng.uniform(-np.pi, np.pi)
        guess = motion + np.array([1.5 * np.cos(bearing), 1.5 * np.sin(bearing), 0.3 * rng.choice([-1, 1])])
        found = search_match(reference, look(room(), compose(start, motion), rng), guess, 1.5, 0.3)
        assert_found(found, motion, 0.02, 0.003)


def test_score_prefers_the_right_of_two_headings() -> None:
    """Driven to and fro, a drift looks alike: what must be seen and is not tells the right heading from the wrong."""
    wrong = right = 0.0
    for seed in range(8):
        rng, walls = np.random.default_rng(seed), drift(0.2, seed)
        start = np.array([0.0, 0.2, 0.0])
        motion = np.array([0.4, 0.1, np.pi if seed % 2 else 0.0])
        reference, current = look(walls, start, rng), look(walls, compose(start, motion), rng)
        scores = [
            score(search_match(reference, current, np.array([0.0, 0.0, heading]), 1.0, 0.2)) for heading in (0.0, np.pi)
        ]
        assert np.argmax(scores) == seed % 2
        right, wrong = right + max(scores), wrong + min(scores)
    assert right - wrong > 0.5


def test_normals_face_the_scanner_and_stand_on_the_wall() -> None:
    scan = look(drift(0.0), np.array([0.0, 0.3, 0.2]))
    fitted = np.isfinite(scan.normals[:, 0])
    assert fitted.sum() > 300
    assert np.all(np.einsum("ij,ij->i", scan.normals[fitted], scan.points[fitted]) < 0)
    in_world = scan.normals[fitted] @ rotation(0.2).T
    assert_allclose(np.abs(in_world), np.tile([0, 1], (fitted.sum(), 1)), atol=1e-6)
    assert np.all(np.isnan(scan.normals[~np.isfinite(scan.points[:, 0])]))


def test_a_smooth_wall_is_known_to_its_very_ends() -> None:
    """Where the field of view cuts a wall off, many points of a scan that looks further hang on its last normals."""
    angles = []
    for seed in range(20):
        scan = look(drift(0.0), np.zeros(3), np.random.default_rng(seed))
        ends = np.flatnonzero(np.isfinite(scan.normals[:, 0]))[[0, 1, 2, -3, -2, -1]]
        angles.append(np.abs(np.arctan(scan.normals[ends, 0] / scan.normals[ends, 1])))
    assert np.sqrt(np.mean(np.square(angles))) < 0.006  # over WALL_LENGTH_M it is 0.03


def test_no_wall_is_drawn_across_an_edge() -> None:
    """Behind the corner of the block the beams go on to the wall of the room: no line joins the two."""
    scan = look(room(), np.array([-1.0, -1.0, 0.0]))
    steps = np.hypot(*np.diff(scan.points, axis=0).T)
    edge = int(np.nanargmax(steps))
    assert steps[edge] > 1.0
    assert_allclose(np.hypot(*scan.normals[np.isfinite(scan.normals[:, 0])].T), 1)
    near = scan.normals[[edge - 3, edge + 4]]
    across = (scan.points[edge + 1] - scan.points[edge]) / steps[edge]
    assert np.all(np.abs(near @ np.array([-across[1], across[0]])) < 0.99)


def test_variance_of_a_normal_is_that_of_noisy_fits() -> None:
    """σ² over the spread of the points along the wall: what is taken out of the information must be what is in it."""
    angles, truth = [], []
    for seed in range(60):
        scan = look(drift(0.0), np.zeros(3), np.random.default_rng(seed))
        beams = slice(60, 180, 10)  # a stretch of the right wall, 2.3 to 4 m away
        angles.append(np.arctan2(scan.normals[beams, 0], scan.normals[beams, 1]))
        truth.append(scan.variances[beams, 1])
    assert_allclose(np.nanvar(angles, axis=0).mean(), np.nanmean(truth), rtol=0.5)
