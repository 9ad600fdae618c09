"""Sensors against what can be computed by hand from the drive."""

import numpy as np
import pytest
import shapely
from msgspec.structs import replace
from numpy.typing import NDArray

from hw_profiles.profile import Mount, Profile, load_profile, parse_profile, read_profile_text
from processing.simulation import sensors
from processing.simulation.drive import Drive
from processing.simulation.raycast import build_grid
from processing.simulation.walls import wall_segments
from processing.simulation.world import Noise, Scanner, Tag

Array = NDArray[np.float64]
QUIET = Noise(range_m=0.0)
TAG = Tag(epc="E20034120000000000000001", at=(0.0, 0.0), read_range_m=3.0, read_probability=1.0)


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def circle_drive(length_m: float, curvature: float, speed_m_s: float) -> Drive:
    """A drive at constant speed from the origin, heading along x, on an arc (or a line, curvature 0)."""
    way = np.linspace(0.0, length_m, int(length_m / 0.01) + 1)
    heading = way * curvature
    if curvature:
        pose = np.column_stack([np.sin(heading) / curvature, (1 - np.cos(heading)) / curvature, heading])
    else:
        pose = np.column_stack([way, 0 * way, heading])
    same = np.ones_like(way)
    return Drive(way / speed_m_s, way, speed_m_s * same, pose, way, curvature * same)


def room_sweeps(drive: Drive, mount: Mount, start_s: Array, noise_m: float = 0.0) -> NDArray[np.float32]:
    grid = build_grid(wall_segments(shapely.box(-10, -2, 12, 3)))
    return sensors.simulate_sweeps(drive, grid, Scanner(), mount, start_s, noise_m, rng())


def test_ranges_of_a_standing_laser_are_the_room() -> None:
    standing = circle_drive(1.0, 0.0, 1.0)
    mount = Mount(x_m=-0.6, y_m=0.2, yaw_deg=180.0)  # looks back from (-0.6, 0.2)
    ranges = room_sweeps(standing, mount, np.array([-1.0]))[0]  # before it sets off
    beam = {degrees: int((degrees + 135) / 0.5) for degrees in (-90, 0, 45, 90)}
    assert ranges[beam[0]] == pytest.approx(9.4, abs=6e-4)
    assert ranges[beam[90]] == pytest.approx(2.2, abs=6e-4)  # to its left is the vehicle's right
    assert ranges[beam[-90]] == pytest.approx(2.8, abs=6e-4)
    assert ranges[beam[45]] == pytest.approx(2.2 * np.sqrt(2), abs=6e-4)
    assert np.all(np.abs(ranges * 1000 - np.round(ranges * 1000)) < 1e-3)  # whole millimetres


def test_a_sweep_of_a_moving_laser_is_distorted_as_computed() -> None:
    moving = circle_drive(10.0, 0.0, 4.0)
    start_s = 0.5
    ranges = room_sweeps(moving, Mount(), np.array([start_s]))[0]
    beam_s = start_s + np.arange(541) / 36_000  # 720 beams would fill the 20 ms of a turn
    angle = np.radians(-135 + 0.5 * np.arange(541))
    ahead = np.abs(angle) < np.arctan2(2, 12)
    expected = (12.0 - 4.0 * beam_s) / np.cos(angle)
    np.testing.assert_allclose(ranges[ahead], expected[ahead], atol=6e-4)
    first, last = np.flatnonzero(ahead)[[0, -1]]
    assert (ranges * np.cos(angle))[first] - (ranges * np.cos(angle))[last] > 0.003  # the wall looks tilted
    assert beam_s[-1] - beam_s[0] == pytest.approx(0.015)


def test_ranges_are_noisy_as_asked_and_end_at_twenty_metres() -> None:
    standing = circle_drive(1.0, 0.0, 1.0)
    ranges = room_sweeps(standing, Mount(), np.full(300, -1.0), 0.012)
    assert np.std(ranges[:, 270]) == pytest.approx(0.012, rel=0.15)
    assert np.mean(ranges[:, 270]) == pytest.approx(12.0, abs=0.003)
    hall = build_grid(wall_segments(shapely.box(-30, -2, 19.995, 3)))
    far = sensors.simulate_sweeps(standing, hall, Scanner(), Mount(), np.full(300, -1.0), 0.012, rng())
    assert 30 < np.sum(np.isposinf(far[:, 270])) < 200  # noise carries some beyond the end
    assert np.max(far[np.isfinite(far)]) <= 20.0
    back = sensors.simulate_sweeps(standing, hall, Scanner(), Mount(yaw_deg=180.0), np.array([-1.0]), 0.012, rng())
    assert np.isposinf(back[0, 270])


def test_another_scanner_sees_as_many_beams_as_wide_and_as_far_as_it_says() -> None:
    scanner = Scanner(beams=181, field_of_view_deg=180.0, range_m=11.0)
    room = build_grid(wall_segments(shapely.box(-10, -2, 12, 3)))
    ranges = sensors.simulate_sweeps(circle_drive(1.0, 0.0, 1.0), room, scanner, Mount(), np.array([-1.0]), 0.0, rng())[
        0
    ]
    assert len(ranges) == 181
    assert (ranges[0], ranges[180]) == pytest.approx((2.0, 3.0), abs=6e-4)  # to the right, to the left
    assert np.isposinf(ranges[90])  # the wall is 12 m ahead
    age = 0.0 - sensors.sweep_times(np.zeros(1), 0.0, scanner)
    assert age >= 0.010 + sensors.TRANSFER_S - 1e-9  # half a turn of the mirror


def test_a_tick_gets_the_newest_sweep_that_was_whole() -> None:
    ticks = np.arange(100) * 0.1
    for phase_s in (0.0, 0.0071, 0.0199):
        age = ticks - sensors.sweep_times(ticks, phase_s, Scanner())
        assert np.all(age >= 0.015 + sensors.TRANSFER_S - 1e-9)
        assert np.all(age < 0.015 + sensors.TRANSFER_S + 0.02 + 1e-9)


def differential(drive: Drive, noise: Noise, times: Array, seed: int = 0) -> Array:
    """Distances (n, 2) that processing will believe, from the first time on."""
    positions = sensors.simulate_encoders(drive, load_profile("canmet_trailer"), times, noise, rng(seed))
    return np.asarray((positions - positions[0]) * 0.35)


def test_wheels_roll_what_the_vehicle_drives() -> None:
    times = np.linspace(0.0, 10.0, 101)
    straight = differential(circle_drive(20.0, 0.0, 2.0), QUIET, times)
    np.testing.assert_allclose(straight, np.column_stack([2 * times, 2 * times]), atol=6e-4)
    left, right = differential(circle_drive(20.0, 0.1, 2.0), QUIET, times).T
    np.testing.assert_allclose(left, 2 * times * (1 - 0.1 * 0.8), atol=6e-4)
    np.testing.assert_allclose(right, 2 * times * (1 + 0.1 * 0.8), atol=6e-4)


def test_systematic_errors_show_as_configured() -> None:
    times = np.linspace(0.0, 50.0, 501)
    wheels = Noise(wheel_radius_error_percent={"left_wheel": 2.0, "right_wheel": -1.0})
    rolled = differential(circle_drive(100.0, 0.0, 2.0), wheels, times)[-1]
    assert rolled == pytest.approx([100 / 1.02, 100 / 0.99], abs=1e-3)
    track = differential(circle_drive(100.0, 0.05, 2.0), Noise(track_width_error_percent=10.0), times)[-1]
    assert track[1] - track[0] == pytest.approx(1.6 * 1.1 * 5.0, abs=2e-3)


def test_slip_grows_with_the_root_of_the_way() -> None:
    noise = Noise(slip_m_per_sqrt_m=0.02)
    ends = np.array([25.0, 100.0]) / 2.0
    drive = circle_drive(100.0, 0.0, 2.0)
    times = np.arange(0.0, 50.01, 0.1)
    rolled = np.concatenate([differential(drive, noise, times, seed)[(ends * 10).astype(int)] for seed in range(150)])
    error = rolled.reshape(150, 2, 2) - np.array([25.0, 100.0])[None, :, None]
    assert np.std(error[:, 0]) == pytest.approx(0.02 * 5, rel=0.15)
    assert np.std(error[:, 1]) == pytest.approx(0.02 * 10, rel=0.15)


def tricycle(axle: str) -> Profile:
    text = read_profile_text("cu_ss534").replace("wheelbase_m", f'drive_axle = "{axle}"\nwheelbase_m')
    return parse_profile(text, "test")


def test_a_tricycle_steers_and_rolls_on_the_axle_of_its_profile() -> None:
    times = np.linspace(0.0, 10.0, 101)
    arc = circle_drive(20.0, 0.2, 2.0)
    delta = np.arctan(1.65 * 0.2)
    count = 2 * np.pi / 4096
    for axle, longer in (("rear", 1.0), ("front", 1 / np.cos(delta))):
        drive_wheel, steering = sensors.simulate_encoders(arc, tricycle(axle), times, QUIET, rng()).T
        np.testing.assert_allclose((drive_wheel - drive_wheel[0]) * 0.25, 2 * times * longer, atol=6e-4)
        np.testing.assert_allclose(steering, delta, atol=count / 2 + 1e-9)
    off = Noise(steering_zero_error_deg=1.0, steering_deg=0.5)
    steering = sensors.simulate_encoders(arc, tricycle("rear"), np.linspace(0, 10, 2001), off, rng())[:, 1]
    assert np.degrees(np.mean(steering) - delta) == pytest.approx(1.0, abs=0.05)
    assert np.degrees(np.std(steering)) == pytest.approx(0.5, rel=0.1)


def reads(tags: list[Tag], places: list[tuple[float, float]], missed: float = 0.0, seed: int = 0) -> tuple[Array, list]:
    drive = circle_drive(40.0, 0.0, 2.0)
    ticks = np.arange(201) * 0.1
    times, readings = sensors.simulate_reads(drive, tags, np.array(places), ticks, -0.13, missed, rng(seed))
    assert np.all((ticks - times >= 0) & (ticks - times < 0.04 + 1e-9))
    return ticks, readings


def test_a_tag_is_read_within_its_range_only() -> None:
    ticks, readings = reads([TAG], [(20.0, 1.0)])
    where = 2.0 * np.array([reading.time_s for reading in readings])
    half = np.sqrt(3.0**2 - 1.0**2)
    assert np.all(np.abs(where - 20.0) <= half)
    assert where.min() < 20 - half + 0.25
    assert where.max() > 20 + half - 0.25
    assert sum(reading.count for reading in readings) == pytest.approx(2 * half / 2 / 0.04, abs=1)  # 25 rounds a second
    for reading in readings:
        assert ticks[reading.tick] - 0.1 < reading.time_s <= ticks[reading.tick]


def test_reads_are_as_probable_as_the_tag_says() -> None:
    shy = Tag(epc=TAG.epc, at=(0.0, 0.0), read_range_m=15.0, read_probability=0.3)
    _, readings = reads([shy], [(20.0, 0.0)])
    assert sum(reading.count for reading in readings) == pytest.approx(0.3 * 375, rel=0.2)


def test_a_tag_is_read_while_it_is_there() -> None:
    """Past x = 20 m at 10 s; put up a little after, or taken away a little before."""
    before, after = replace(TAG, until_s=9.9), replace(TAG, from_s=10.1)
    _, readings = reads([before, after], [(20.0, 1.0)] * 2)
    times = [reading.time_s for reading in readings]
    assert any(time < 9.9 for time in times)
    assert any(time > 10.1 for time in times)
    assert not any(9.9 < time < 10.1 for time in times)


def test_passes_are_missed_as_often_as_asked() -> None:
    tags = [Tag(epc=f"{k:024X}", at=(0.0, 0.0), read_probability=1.0) for k in range(300)]
    _, readings = reads(tags, [(10.0, 0.0)] * 300, missed=0.25)
    found = {reading.epc for reading in readings}
    assert 1 - len(found) / 300 == pytest.approx(0.25, abs=0.08)
    counts = [sum(r.count for r in readings if r.epc == epc) for epc in sorted(found)[:20]]
    assert min(counts) >= 74  # a pass is missed whole or not at all


def test_a_tag_at_the_start_is_read_from_the_first_tick() -> None:
    _, readings = reads([TAG], [(0.0, 0.0)])
    assert readings[0].tick == 0
