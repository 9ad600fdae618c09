"""Walls: smooth ones where drawn, rough ones as rough as asked, one geometry for a seed."""

import numpy as np
import pytest
import shapely

from processing.simulation.walls import free_space, periodic_noise, wall_segments
from processing.simulation.world import World, parse_world

RUN = '[[runs]]\nname = "r"\nwaypoints = [[1, 0], [9, 0]]\nspeed_m_s = 1.0\n'


def world(drifts: str, walls: str = "") -> World:
    return parse_world(f'schema = 1\nname = "w"\nprofile = "canmet_trailer"\n{walls}\n{drifts}\n{RUN}', "test")


def drift(points: str, width: float = 4.0, more: str = "") -> str:
    return f"[[drifts]]\npoints = {points}\nwidth_m = {width}\n{more}\n"


def space(world: World, seed: int = 0) -> shapely.Geometry:
    return free_space(world, np.random.default_rng(seed))


def test_a_straight_smooth_drift_is_a_rectangle() -> None:
    area = space(world(drift("[[0, 0], [10, 0]]")))
    assert area.equals(shapely.box(0, -2, 10, 2))
    segments = wall_segments(area)
    lengths = np.hypot(*(segments[:, 2:] - segments[:, :2]).T)
    assert lengths.sum() == pytest.approx(28.0)
    assert lengths.max() <= 2.0


def test_drifts_open_into_each_other_where_they_meet() -> None:
    tee = space(world(drift("[[0, 0], [20, 0]]") + drift("[[10, 0], [10, 15]]")))
    assert tee.area == pytest.approx(20 * 4 + 4 * 13)
    corner = space(world(drift("[[0, 0], [10, 0]]") + drift("[[10, 0], [10, 10]]")))
    assert corner.contains(shapely.Point(11.3, -1.3))  # no notch outside the corner


def test_pillars_are_rock_and_rooms_are_free() -> None:
    more = "[[pillars]]\nat = [5, 0]\nradius_m = 0.5\n[[rooms]]\ncorners = [[2, 1], [4, 1], [4, 6], [2, 6]]\n"
    area = space(world(drift("[[0, 0], [10, 0]]") + more))
    assert not area.contains(shapely.Point(5, 0))
    assert area.contains(shapely.Point(3, 5))


def test_parts_that_do_not_meet_stay_apart() -> None:
    area = space(world(drift("[[0, 0], [10, 0]]") + drift("[[0, 50], [10, 50]]"), "[walls]\nroughness_m = 0.1"))
    assert len(shapely.get_parts(area)) == 2


def test_walls_are_as_rough_as_asked() -> None:
    rough = space(world(drift("[[0, 0], [900, 0]]", 5.0), "[walls]\nroughness_m = 0.2\ncorrelation_m = 1.5"))
    points = shapely.get_coordinates(rough)
    inner = points[(points[:, 0] > 5) & (points[:, 0] < 895)]
    height = np.abs(inner[:, 1]) - 2.5
    assert np.std(height) == pytest.approx(0.2, rel=0.1)
    assert abs(np.mean(height)) < 0.03


def test_roughness_of_one_drift_stands_for_itself() -> None:
    walls = "[walls]\nroughness_m = 0.2"
    area = space(world(drift("[[0, 0], [100, 0]]") + drift("[[0, 30], [100, 30]]", 4.0, "roughness_m = 0.0"), walls))
    points = shapely.get_coordinates(area)
    middle = points[(points[:, 0] > 5) & (points[:, 0] < 95)]
    smooth, rough = middle[middle[:, 1] > 15, 1], middle[middle[:, 1] < 15, 1]
    np.testing.assert_allclose(np.abs(smooth - 30), 2.0, atol=1e-9)
    assert np.std(np.abs(rough)) > 0.1


def test_noise_has_unit_variance_and_its_correlation_length() -> None:
    noise = periodic_noise(200_000, 0.1, 1.5, np.random.default_rng(1))
    assert np.std(noise) == pytest.approx(1.0, rel=0.02)
    correlation = np.mean(noise * np.roll(noise, 15))  # one length scale apart
    assert correlation == pytest.approx((1 + np.sqrt(3)) * np.exp(-np.sqrt(3)), abs=0.02)  # Matérn 3/2


def test_one_seed_one_geometry() -> None:
    rough = world(drift("[[0, 0], [50, 0]]"), "[walls]\nroughness_m = 0.2")
    assert space(rough, 1).equals(space(rough, 1))
    assert not space(rough, 1).equals(space(rough, 2))
