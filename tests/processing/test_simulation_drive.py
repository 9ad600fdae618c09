"""Drives: what a vehicle can drive, consistent in pose, distance and curvature, and clear of the walls."""

import numpy as np
import pytest

from hw_profiles.errors import BadInputError
from processing.simulation.drive import Drive, limit_speed, plan_drive, round_corners, turn_angles
from processing.simulation.simulate import build_drive, build_space
from processing.simulation.world import World, parse_world

WORLD = """
schema = 1
name = "w"
profile = "canmet_trailer"
[places]
a = [0, 0]
b = [40, 0]
c = [40, 30]
[[drifts]]
points = ["a", "b", [60, 0]]
width_m = 4.6
[[drifts]]
points = ["b", "c"]
width_m = 4.6
[[runs]]
name = "r"
waypoints = WAYPOINTS
speed_m_s = 2.0
MORE
"""


def world(waypoints: str, more: str = "") -> World:
    return parse_world(WORLD.replace("WAYPOINTS", waypoints).replace("MORE", more), "test")


def drive(waypoints: str, more: str = "", seed: int = 0) -> Drive:
    planned = world(waypoints, more)
    return plan_drive(planned, planned.runs[0], np.random.default_rng(seed))


def test_a_straight_drive_is_timed_by_hand() -> None:
    straight = drive("[[2, 0], [34, 0]]", "[driving]\nwander_m = 0.0\nacceleration_m_s2 = 0.5\nwait_s = 3.0")
    # 2 m/s at 0.5 m/s²: 4 s and 4 m to speed up, as much to brake, 24 m between at 2 m/s, 3 s of standing at each end
    assert straight.duration_s == pytest.approx(3 + 4 + 12 + 4 + 3, abs=0.05)
    assert straight.length_m == pytest.approx(32.0, abs=1e-9)
    times = np.array([-1.0, 0.0, 3.0, 5.0, 7.0, 13.0, 23.0, 99.0])
    poses = straight.poses_at(times)
    np.testing.assert_allclose(poses[:, 0], [2, 2, 2, 3, 6, 18, 34, 34], atol=0.03)
    np.testing.assert_allclose(poses[:, 1:], 0.0, atol=1e-9)


def test_the_vehicle_never_slides_sideways() -> None:
    way = drive('["a", "b", [60, 0], "b", "c"]')
    times = np.arange(0.0, way.duration_s, 0.01)
    poses = way.poses_at(times)
    step = np.diff(poses, axis=0)
    middle = (poses[1:, 2] + poses[:-1, 2]) / 2
    sideways = -np.sin(middle) * step[:, 0] + np.cos(middle) * step[:, 1]
    ahead = np.cos(middle) * step[:, 0] + np.sin(middle) * step[:, 1]
    assert np.abs(sideways).max() < 1e-4
    np.testing.assert_allclose(ahead, np.diff(way.at(times, way.distance_m)), atol=1e-4)
    turned = np.diff(poses[:, 2])
    np.testing.assert_allclose(turned, ahead * way.at(times[:-1] + 0.005, way.curvature), atol=1e-3)


def test_speed_and_accelerations_stay_in_their_bounds() -> None:
    way = drive('["a", "b", "c"]')
    times = np.arange(0.0, way.duration_s, 0.02)
    speed = np.diff(way.way_at(times)) / 0.02
    assert speed.max() < 2.0 + 1e-6
    assert np.abs(np.diff(speed) / 0.02).max() < 0.8 + 0.05
    lateral = speed**2 * np.abs(way.at(times[:-1] + 0.01, way.curvature))
    assert lateral.max() < 1.0 + 0.05
    assert np.abs(way.curvature).max() < 1 / 3.5
    assert np.abs(np.diff(way.curvature)).max() < 0.02  # no jump of the steering


def test_driving_back_the_way_one_came_is_done_in_reverse() -> None:
    way = drive('["a", "b", [58, 0], "b", "c"]')
    assert way.distance_m[-1] == pytest.approx(58 - (way.length_m - 58), abs=0.5)
    end = way.pose[-1]
    assert end[:2] == pytest.approx([40, 30], abs=1e-6)
    assert np.degrees(end[2]) == pytest.approx(-90.0, abs=1e-6)  # backed into the drift, looking out
    assert np.abs(np.diff(way.pose[:, 2])).max() < 0.02


def test_it_stands_where_told_for_as_long_as_told() -> None:
    way = drive('["a", "b", [58, 0]]', "stops_s = { b = 7.0 }")
    without = drive('["a", "b", [58, 0]]')
    times = np.arange(0.0, way.duration_s, 0.01)
    at_b = np.hypot(*(way.poses_at(times)[:, :2] - [40, 0]).T) < 0.3
    still = np.append(np.diff(way.way_at(times)) == 0.0, False)
    assert np.sum(at_b & still) * 0.01 == pytest.approx(7.0, abs=0.05)
    assert way.duration_s > without.duration_s + 7.0


def test_drivers_wander_each_in_his_own_way_within_the_spread() -> None:
    offsets = [drive("[[2, 0], [38, 0]]", seed=seed).pose[:, 1] for seed in range(60)]
    middle = np.array([offset[len(offset) // 2] for offset in offsets])
    assert np.std(middle) == pytest.approx(0.15, rel=0.3)
    assert max(abs(offset[0]) for offset in offsets) < 1e-9


def test_corners_are_rounded_by_the_asked_radius() -> None:
    points = np.array([[0.0, 0.0], [20.0, 0.0], [20.0, 20.0]])
    line, marks = round_corners(points, 5.0, "test")
    arc = line[1:-1]
    np.testing.assert_allclose(np.hypot(arc[:, 0] - 15, arc[:, 1] - 5), 5.0, atol=1e-9)
    np.testing.assert_allclose(marks, [0, 15 + 5 * np.pi / 4, 30 + 5 * np.pi / 2], atol=1e-3)
    assert turn_angles(points) == pytest.approx([np.pi / 2])


def test_speed_limits_are_approached_with_the_acceleration() -> None:
    way = np.linspace(0.0, 20.0, 2001)
    limit = np.where(way < 10.0, 4.0, 1.0)
    limit[0] = 0.0
    speed = limit_speed(way, limit, 0.5)
    assert speed[0] == 0.0
    np.testing.assert_allclose(np.diff(speed**2) / np.diff(way), np.clip(np.diff(speed**2) / np.diff(way), -1, 1))
    assert speed[400] == pytest.approx(2.0)  # 4 m at 0.5 m/s²
    assert speed[1000] == 1.0


@pytest.mark.parametrize(
    ("waypoints", "message"),
    [
        ('["a", "b", [36, 4]]', "no room to turn by 135° at"),
        ('["a", [0.2, 0.0], "b"]', "less than a metre apart"),
        ('["a", [20, 12], "b"]', r"w: run r comes within 0.5 m of a wall or through it at \["),
        ("[[0, 90], [40, 90]]", r"w: run r comes within 0.5 m of a wall or through it at \["),
    ],
)
def test_what_cannot_be_driven_is_refused(waypoints: str, message: str) -> None:
    planned = world(waypoints)
    with pytest.raises(BadInputError, match=message):
        build_drive(planned, planned.runs[0], 0, build_space(planned, 0))
