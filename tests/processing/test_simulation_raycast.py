"""Ray casting against what shapely finds, and against distances known by hand."""

import numpy as np
import pytest
import shapely

from processing.simulation.raycast import build_grid, cast
from processing.simulation.walls import wall_segments


def test_ranges_in_a_room_are_known() -> None:
    grid = build_grid(wall_segments(shapely.box(0, 0, 10, 4)))
    angles = np.array([0.0, np.pi / 2, np.pi, -np.pi / 2, np.arctan2(2, 7), np.pi + np.arctan2(2, 3)])
    origins = np.tile([3.0, 2.0], (len(angles), 1))
    expected = [7.0, 2.0, 3.0, 2.0, np.hypot(2, 7), np.hypot(2, 3)]
    np.testing.assert_allclose(cast(grid, origins, angles, 20.0), expected, atol=1e-12)
    assert np.isinf(cast(grid, origins[:1], angles[:1], 6.9)[0])


def test_beams_meet_what_shapely_says_they_meet() -> None:
    generator = np.random.default_rng(3)
    centres = shapely.points(generator.uniform(0, 30, (25, 2)))
    blob = shapely.union_all(shapely.buffer(centres, generator.uniform(2, 5, 25)))
    hall = max(shapely.get_parts(blob), key=lambda part: part.area)
    segments = wall_segments(hall)
    walls = shapely.union_all(shapely.linestrings(segments.reshape(-1, 2, 2)))
    origins = generator.uniform(0, 30, (3000, 2))
    origins = origins[shapely.contains_xy(hall, origins)][:400]
    angles = generator.uniform(-10, 10, len(origins))
    ends = origins + 20.0 * np.column_stack([np.cos(angles), np.sin(angles)])
    expected = []
    for start, beam in zip(origins, shapely.linestrings(np.stack([origins, ends], axis=1)), strict=True):
        hits = shapely.intersection(beam, walls)
        expected.append(np.inf if hits.is_empty else shapely.distance(shapely.Point(start), hits))
    found = cast(build_grid(segments), origins, angles, 20.0)
    assert len(origins) == 400
    np.testing.assert_allclose(found, expected, atol=1e-8)


def test_no_beam_slips_through_a_corner() -> None:
    grid = build_grid(wall_segments(shapely.box(-1, -1, 1, 1)))
    angles = np.radians([45.0, 135.0, 225.0, 315.0])
    found = cast(grid, np.zeros((4, 2)), angles, 20.0)
    np.testing.assert_allclose(found, np.sqrt(2), atol=1e-8)


@pytest.mark.parametrize("angle", [0.0, np.pi / 2, np.pi, -np.pi / 2])
def test_a_beam_along_a_grid_line_ends_at_the_wall(angle: float) -> None:
    grid = build_grid(wall_segments(shapely.box(0, 0, 8, 8)))
    on_line = grid.origin + 8 * 0.5  # the crossing of two borders of cells
    distance = cast(grid, on_line[None], np.array([angle]), 20.0)[0]
    ahead = on_line @ [np.cos(angle), np.sin(angle)]
    assert distance == pytest.approx((8 - ahead) if angle in (0.0, np.pi / 2) else -ahead, abs=1e-9)
