"""A room scanned from inside: walls where they are, free within, unknown beyond; stitching leaves no hole."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from processing.geometry import compose, inverse, transform
from processing.occupancy_grid import HIGHEST, HIT, LOWEST, MISS, STEP, Grid, View, build_grid
from processing.stitching import add_grid, stitch

CELL = 0.05
ANGLES = np.radians(np.linspace(-135, 135, 541))
WIDTH, HEIGHT = 12.0, 8.0


def scan_room(pose: np.ndarray, angles: np.ndarray = ANGLES) -> np.ndarray:
    """Ranges (B,) to the walls of the room around the origin."""
    c, s = np.cos(pose[2] + angles + 1e-9), np.sin(pose[2] + angles + 1e-9)
    to_x = (np.sign(c) * WIDTH / 2 - pose[0]) / c
    to_y = (np.sign(s) * HEIGHT / 2 - pose[1]) / s
    return np.minimum(to_x, to_y)


def draw(poses: np.ndarray, ranges: np.ndarray, angles: np.ndarray, **limits: float) -> Grid:
    """The grid of scans that were measured standing still."""
    unit = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    points = np.where(np.isfinite(ranges), ranges, np.nan)[..., None] * unit
    return build_grid([View(poses, points.astype(np.float32), ranges.astype(np.float32), angles)], **limits)


def distance_to_wall(points: np.ndarray) -> np.ndarray:
    """Of points (n, 2) near the room, to its outline."""
    x, y = WIDTH / 2 - np.abs(points[:, 0]), HEIGHT / 2 - np.abs(points[:, 1])
    return np.where((x >= 0) & (y >= 0), np.minimum(x, y), np.hypot(np.minimum(x, 0), np.minimum(y, 0)))


def outline(step: float = 0.02) -> np.ndarray:
    x, y = np.arange(-WIDTH / 2, WIDTH / 2, step), np.arange(-HEIGHT / 2, HEIGHT / 2, step)
    sides = [np.column_stack([x, np.full(len(x), s * HEIGHT / 2)]) for s in (-1, 1)]
    sides += [np.column_stack([np.full(len(y), s * WIDTH / 2), y]) for s in (-1, 1)]
    return np.concatenate(sides)


def centres(grid: Grid, where: np.ndarray) -> np.ndarray:
    rows, columns = np.nonzero(where)
    return grid.origin + grid.resolution_m * (np.column_stack([columns, rows]) + 0.5)


def value_at(grid: Grid, points: np.ndarray) -> np.ndarray:
    columns, rows = np.floor((points - grid.origin) / grid.resolution_m + 1e-9).astype(int).T
    return grid.log_odds[rows, columns]


@pytest.fixture(scope="module")
def drive() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(3)
    poses = np.column_stack([np.linspace(-4, 4, 100), rng.uniform(-1, 1, 100), np.linspace(-2, 3, 100)])
    return poses, np.array([scan_room(pose) for pose in poses])


@pytest.fixture(scope="module")
def room(drive: tuple[np.ndarray, np.ndarray]) -> Grid:
    return draw(*drive, ANGLES)


def test_walls_within_one_cell_and_free_within(room: Grid) -> None:
    assert distance_to_wall(centres(room, room.log_odds > 0)).max() <= CELL
    walls = centres(room, room.log_odds > 0)
    gaps = [np.hypot(*(walls - point).T).min() for point in outline(0.1)]
    assert max(gaps) <= 2 * CELL
    inside = np.random.default_rng(2).uniform(-1, 1, (2000, 2)) * [WIDTH / 2 - 0.2, HEIGHT / 2 - 0.2]
    assert value_at(room, inside).max() < 0


def test_frame_of_the_poses_is_the_frame_of_the_grid(drive, room: Grid) -> None:
    place = np.array([100.3, -50.2, 0.7])
    moved = draw(compose(place, drive[0]), drive[1], ANGLES)
    walls = centres(moved, moved.log_odds > 0)
    assert distance_to_wall(transform(inverse(place), walls)).max() <= CELL
    assert_allclose(moved.origin / CELL, np.round(moved.origin / CELL), atol=1e-6)


def test_a_grazed_wall_survives(drive) -> None:
    """Along a drift most beams that end on the wall ahead pass within a cell of the wall beside."""
    poses = np.column_stack([np.linspace(1, 58, 150), np.full(150, 0.013), np.full(150, 0.004)])
    bearings = poses[:, 2:] + ANGLES
    half_m = 1.02  # inside of a cell, so that beams do pass through it before they end in it further on
    ranges = (np.sign(bearings) * half_m - poses[:, 1:2]) / np.sin(bearings)
    grid = draw(poses, ranges, ANGLES)
    along = np.arange(5, 50, 0.05) + 0.01
    for side in (-half_m, half_m):
        assert value_at(grid, np.column_stack([along, np.full(len(along), side)])).min() > 1


def test_hits_win_within_a_scan_and_each_cell_is_told_once() -> None:
    # three beams end in one cell, a fourth passes it to a far wall; ten more pass the same free cells
    angles = np.array([0.0, 0.001, 0.002, 0.003])
    grid = draw(np.zeros((1, 3)), np.array([[1.02, 1.02, 1.02, 3.02]]), angles)
    assert_allclose(value_at(grid, np.array([[1.02, 0.001], [0.5, 0.001]])), [HIT * STEP, MISS * STEP])
    assert_allclose(grid.log_odds.max(), HIT * STEP)


def test_saturation(drive) -> None:
    pose = np.zeros((200, 3))
    grid = draw(pose, np.repeat(scan_room(pose[0])[None], 200, axis=0), ANGLES)
    assert_allclose([grid.log_odds.min(), grid.log_odds.max()], [LOWEST * STEP, HIGHEST * STEP])


def test_beams_without_return_invalid_and_far_ones() -> None:
    angles = np.radians([0.0, 90.0, 180.0, -90.0])
    grid = draw(np.zeros((1, 3)), np.array([[np.inf, np.nan, 30.0, -1.0]]), angles, max_range_m=20, no_return_m=5)
    assert grid.log_odds.max() == 0
    free = centres(grid, grid.log_odds < 0)
    assert_allclose([free[:, 0].min(), free[:, 0].max()], [-20, 5], atol=2 * CELL)
    assert np.abs(free[:, 1]).max() < 2 * CELL


def test_no_scans_make_an_empty_grid() -> None:
    assert draw(np.zeros((0, 3)), np.zeros((0, 541)), ANGLES).log_odds.size == 0


def test_stitching_at_identity_changes_nothing(room: Grid) -> None:
    same = stitch([room], np.zeros((1, 3)))
    assert_array_equal(same.log_odds, room.log_odds)
    assert_allclose(same.origin, room.origin)
    twice = stitch([room, room], np.zeros((2, 3)))
    assert_array_equal(twice.log_odds, 2 * room.log_odds)


@pytest.mark.parametrize("angle", np.linspace(0.1, 6.2, 7).tolist())
def test_turned_stitch_leaves_no_holes(room: Grid, angle: float) -> None:
    place = np.array([7.123, -3.456, angle])
    turned = stitch([room], place[None])
    assert distance_to_wall(transform(inverse(place), centres(turned, turned.log_odds > 0))).max() <= 2 * CELL
    inside = np.random.default_rng(4).uniform(-1, 1, (5000, 2)) * [WIDTH / 2 - 0.2, HEIGHT / 2 - 0.2]
    assert value_at(turned, transform(place, inside)).max() < 0
    walls = centres(turned, turned.log_odds > 0)
    gaps = [np.hypot(*(walls - point).T).min() for point in transform(place, outline(0.1))]
    assert max(gaps) <= 2 * CELL


def test_windows_make_the_same_map_as_the_whole(room: Grid) -> None:
    placements = np.array([[0, 0, 0.3], [9.0, 2.0, -1.0]])
    whole = stitch([room, room], placements)
    half = whole.log_odds.shape[1] // 2
    left = Grid(np.zeros_like(whole.log_odds[:, :half]), CELL, whole.origin)
    right = Grid(np.zeros_like(whole.log_odds[:, half:]), CELL, whole.origin + np.array([half * CELL, 0]))
    for window in (left, right):
        for pose in placements:
            add_grid(window, room, pose)
    assert_allclose(np.hstack([left.log_odds, right.log_odds]), whole.log_odds, atol=1e-4)


def test_grids_of_different_cells_are_refused(room: Grid) -> None:
    with pytest.raises(ValueError, match="one resolution"):
        stitch([room, Grid(room.log_odds, 0.1, room.origin)], np.zeros((2, 3)))


def cells_passed(pose: np.ndarray, ranges: np.ndarray) -> tuple[set[tuple[int, int]], set[tuple[int, int]]]:
    """Row and column, from the frame's origin, of the cells that single beams pass and end in: one after the other."""
    passed, hit = set(), set()
    for bearing, distance in zip(pose[2] + ANGLES, ranges, strict=True):
        start, way = pose[:2] / CELL, distance / CELL * np.array([np.cos(bearing), np.sin(bearing)])
        steps = np.abs(way).max()
        for x, y in start + way * (np.arange(int(steps)) / steps)[:, None]:
            passed.add((int(np.floor(y)), int(np.floor(x))))
        x, y = start + way
        hit.add((int(np.floor(y)), int(np.floor(x))))
    return passed - hit, hit


def test_beams_that_pass_for_their_neighbours_leave_no_cell_out() -> None:
    rng = np.random.default_rng(8)
    for _ in range(10):
        pose = np.array([*rng.uniform(-2, 2, 2), rng.uniform(-3, 3)])
        rubble = rng.uniform(0.3, 1.0, len(ANGLES)) if rng.random() < 0.5 else 1.0
        ranges = 0.993 * rubble * scan_room(pose)  # the room's walls lie between two cells
        grid = draw(pose[None], ranges[None], ANGLES)
        first = np.rint(grid.origin[::-1] / CELL).astype(int)
        for expected, found in zip(cells_passed(pose, ranges), (grid.cells < 0, grid.cells > 0), strict=True):
            cells = {tuple(cell) for cell in (np.argwhere(found) + first).tolist()}
            assert len(cells ^ expected) <= 0.003 * len(expected)  # float and fixed point at the edges of cells
