"""Hazards: each changes what it says and nothing else; the drive stays true; what is left to chance is the seed's."""

from dataclasses import fields
from functools import cache

import numpy as np
import pytest
import shapely
from numpy.typing import NDArray

from hw_profiles.errors import BadInputError
from hw_profiles.profile import load_profile
from processing.simulation.drive import Drive
from processing.simulation.hazard_vehicle import true_profile
from processing.simulation.hazard_walls import space_of
from processing.simulation.hazards import KINDS, hazard_table
from processing.simulation.lots import strikes_of
from processing.simulation.raycast import build_grid
from processing.simulation.recording import Samples
from processing.simulation.simulate import build_drive, build_space, sample_run
from processing.simulation.walls import new_walls, wall_segments
from processing.simulation.world import parse_world

Array = NDArray[np.float64]
WORLD = """
schema = 1
name = "two"
seed = 3
profile = "PROFILE"
[places]
a = [0, 0]
b = [36, 0]
c = [36, 12]
d = [0, 12]
[[drifts]]
points = ["a", "b", "c", "d"]
width_m = 4.6
[[tags]]
epc = "E20034120000000000000001"
at = [18, 1.5]
[[tags]]
epc = "E20034120000000000000002"
at = [20, 13.5]
[[runs]]
name = "there"
waypoints = [[3, 0], "b", "c", [4, 12]]
speed_m_s = 2.5
[[runs]]
name = "back"
waypoints = [[3, 12], "c", "b", [4, 0]]
speed_m_s = 2.5
"""
RADIUS_M, COUNT_M = 0.35, 0.35 * 2 * np.pi / 4096  # of canmet_trailer, whose scanner looks astern
FIRST, SECOND = "E20034120000000000000001", "E20034120000000000000002"


@cache
def sampled(hazard: str = "", run: int = 0, seed: int = 3, profile: str = "canmet_trailer") -> tuple[Samples, Drive]:
    """A run of the world, struck by one hazard, given as its TOML in one line."""
    struck = f"hazards = [{{ {hazard} }}]" if hazard else ""
    world = parse_world(f"{struck}\n{WORLD}".replace("PROFILE", profile), "two.toml")
    space = build_space(world, seed)
    drive = build_drive(world, world.runs[run], seed, space)
    grid = build_grid(wall_segments(space_of(world.runs[run], world, space, seed)))
    return sample_run(world, world.runs[run], drive, grid, load_profile(profile), seed), drive


def changed(hazard: str, run: int = 0, profile: str = "canmet_trailer") -> set[str]:
    """Which fields of the samples are not as without the hazard."""
    with_it, without = sampled(hazard, run, profile=profile)[0], sampled("", run, profile=profile)[0]
    names = [field.name for field in fields(Samples)]
    return {name for name in names if not np.array_equal(getattr(with_it, name), getattr(without, name))}


WHAT_CHANGES = {
    'kind = "slip"': "positions",
    'kind = "spin"': "positions",
    'kind = "slide", at_s = 5': "positions",
    'kind = "stuck"': "positions",
    'kind = "jump"': "positions",
    'kind = "reset"': "positions",
    'kind = "lost_counts"': "positions",
    'kind = "odometry_late"': "positions",
    'kind = "scans_late"': "ranges",
    'kind = "jitter"': "sweep_s latched_s",
    'kind = "jitter", of = "scans"': "sweep_s",
    'kind = "odometry_missing"': "has_joints",
    'kind = "scans_missing"': "has_scan",
    'kind = "dropouts"': "ranges",
    'kind = "dust"': "ranges",
    'kind = "own_parts"': "ranges",
    'kind = "traffic"': "ranges",
    'kind = "traffic", way = "oncoming"': "ranges",
    'kind = "traffic", way = "parked"': "ranges",
    'kind = "changed_walls", run = "there"': "ranges",
    'kind = "far_reads"': "readings",
    'kind = "through_rock"': "readings",
    'kind = "dead_tag", run = "there", at_s = 0': "readings",
    'kind = "wrong_mount"': "ranges",
    'kind = "wrong_radii"': "positions",
    'kind = "wrong_track"': "positions",
    'kind = "slip", run = "back"': "",  # another run
}


@pytest.mark.parametrize("hazard", WHAT_CHANGES)
def test_a_hazard_changes_what_it_says_and_nothing_else(hazard: str) -> None:
    assert changed(hazard) == set(WHAT_CHANGES[hazard].split())
    assert np.array_equal(sampled(hazard)[1].pose, sampled()[1].pose)


def test_every_kind_is_tried_and_documented() -> None:
    assert {hazard.split('"')[1] for hazard in WHAT_CHANGES} == set(KINDS)
    table = "\n".join(hazard_table())
    assert all(f"  {kind} " in table for kind in KINDS)
    assert max(map(len, table.splitlines())) <= 120


def test_the_seed_decides_what_is_left_to_chance() -> None:
    hazard = 'kind = "slip"'
    again = sampled.__wrapped__(hazard)[0]
    assert np.array_equal(again.positions, sampled(hazard)[0].positions)
    off = [sampled(hazard, seed=seed)[0].positions - sampled(seed=seed)[0].positions for seed in (3, 4)]
    assert not np.array_equal(off[0][:100], off[1][:100])


def turned(hazard: str, profile: str = "canmet_trailer") -> tuple[Array, Array, Array]:
    """What each encoder turns from tick to tick (n, 2), with the hazard and without; the ends of the ticks (n,)."""
    with_it, without = (sampled(each, profile=profile)[0] for each in (hazard, ""))
    return np.diff(with_it.positions, axis=0), np.diff(without.positions, axis=0), without.latched_s[1:]


def test_a_slipping_wheel_counts_wrongly_while_the_vehicle_drives_on() -> None:
    found, true, time_s = turned('kind = "slip", at_s = 10, for_s = 1, wheel = "left_wheel", factor = 0.5')
    within = (time_s > 10) & (time_s <= 11)
    assert within.sum() == 10
    np.testing.assert_allclose(found[within, 0], true[within, 0] / 2, atol=1.1 * COUNT_M / RADIUS_M)
    assert np.array_equal(found[:, 1], true[:, 1])
    np.testing.assert_allclose(found[~within], true[~within], atol=1.1 * COUNT_M / RADIUS_M)
    turn = ((found - true) * RADIUS_M @ [-1, 1] / 1.6).sum()  # what the odometry believes of the heading
    assert turn == pytest.approx(1.25 / 1.6, rel=0.05)  # half of 2.5 m is lost on the left


def test_spinning_wheels_turn_while_the_vehicle_stands_and_sliding_ones_stand_while_it_drives() -> None:
    found, true, time_s = turned('kind = "spin", at_s = 0.4, for_s = 1, extra_m_s = 1.5')
    assert np.all(true[time_s < 1.5] == 0)
    np.testing.assert_allclose(found[time_s < 1.5].sum(axis=0) * RADIUS_M, 1.5, atol=0.16)
    found, true, time_s = turned('kind = "slide", at_s = 8, for_s = 2')
    within = (time_s > 8) & (time_s <= 10)
    assert np.all(true[within] > 0)
    assert np.all(found[within] == 0)
    np.testing.assert_allclose(found[~within], true[~within], atol=1e-9)


def test_stuck_encoders_repeat_their_angle_and_count_on_from_there() -> None:
    found, true, time_s = turned('kind = "stuck", at_s = 8, for_s = 3')
    within = (time_s > 8) & (time_s <= 11)
    assert np.all(found[within] == 0)
    np.testing.assert_allclose(found[~within], true[~within], atol=1e-9)
    stuck = sampled('kind = "stuck", at_s = 13, for_s = 3', profile="cu_ss534")[0].positions[:, 1]  # steering
    free, time_s = sampled(profile="cu_ss534")[0].positions[:, 1], sampled(profile="cu_ss534")[0].latched_s
    within = (time_s > 13) & (time_s <= 16)
    assert np.ptp(free[within]) > 0.1
    assert np.ptp(stuck[within]) == 0
    assert np.array_equal(stuck[~within], free[~within])


def test_counts_jump_start_anew_and_are_lost() -> None:
    base = sampled()[0]
    after = base.latched_s > 12
    jump = sampled('kind = "jump", at_s = 12, wheel = "right_wheel", turns = -0.5')[0].positions - base.positions
    np.testing.assert_allclose(jump[after, 1], -np.pi, atol=1e-9)
    assert np.all(jump[~after] == 0)
    assert np.all(jump[:, 0] == 0)
    reset = sampled('kind = "reset", at_s = 12')[0].positions
    assert np.all(np.abs(reset[after][0]) < 1e-9)
    np.testing.assert_allclose(np.diff(reset[after], axis=0), np.diff(base.positions[after], axis=0), atol=1e-9)
    lost = sampled('kind = "lost_counts", wheel = "left_wheel", share = 0.2')[0].positions
    way = np.ptp(base.positions, axis=0)
    assert np.ptp(lost, axis=0) == pytest.approx(way * [0.8, 1.0], rel=0.01)


def test_what_comes_late_is_older_than_its_stamp() -> None:
    base = sampled()[0]
    late = sampled('kind = "odometry_late", delay_s = 0.1')[0].positions
    np.testing.assert_allclose(late[1:], base.positions[:-1], atol=2.5 * 2e-3 / RADIUS_M + 2e-3)
    scans = sampled('kind = "scans_late", delay_s = 0.2')[0].ranges
    ahead = np.flatnonzero((base.sweep_s > 6) & (base.sweep_s < 9))  # straight on, with the dead end in view astern
    grown = np.median(base.ranges[ahead][:, 270] - scans[ahead][:, 270])
    assert grown == pytest.approx(0.2 * 2.5, abs=0.02)


def test_jitter_moves_stamps_and_keeps_their_order() -> None:
    base, jittered = sampled()[0], sampled('kind = "jitter", std_s = 0.03')[0]
    for name in ("sweep_s", "latched_s"):
        assert np.std(getattr(jittered, name) - getattr(base, name)) == pytest.approx(0.03, rel=0.2)
        assert np.all(np.diff(getattr(jittered, name)) >= 0)


def test_missing_messages_are_missing_for_so_long() -> None:
    base, gone = sampled()[0], sampled('kind = "scans_missing", at_s = 9.0, for_s = 2.0')[0]
    within = (base.sweep_s > 9) & (base.sweep_s <= 11)
    assert np.array_equal(gone.has_scan, base.has_scan & ~within)
    assert 19 <= within.sum() <= 21
    assert 28 <= np.sum(~sampled('kind = "odometry_missing"')[0].has_joints) <= 31


def test_beams_are_lost_or_end_on_dust_as_often_as_said() -> None:
    base = sampled()[0].ranges
    dropped = sampled('kind = "dropouts", share = 0.3')[0].ranges
    assert np.mean(np.isinf(dropped[np.isfinite(base)])) == pytest.approx(0.3, abs=0.01)
    assert np.array_equal(dropped[np.isfinite(dropped)], base[np.isfinite(dropped)])
    dusty = sampled('kind = "dust", share = 0.2, reach_m = 1.5, at_s = 10, for_s = 5')[0]
    within = (dusty.sweep_s > 10) & (dusty.sweep_s <= 15)
    nearer = dusty.ranges[within] < base[within]
    assert nearer.mean() == pytest.approx(0.2, abs=0.01)
    assert dusty.ranges[within][nearer].max() <= 1.5
    assert np.array_equal(dusty.ranges[~within], base[~within])


def test_a_part_of_the_vehicle_is_in_every_scan() -> None:
    base = sampled()[0].ranges
    plate = sampled('kind = "own_parts", from_deg = 20, to_deg = 50, distance_m = 0.8')[0].ranges
    sector = slice(2 * 155, 2 * 185 + 1)  # half a degree a beam, from -135°
    np.testing.assert_allclose(
        np.median(plate[:, sector], axis=0)[[0, 30, 60]], 0.8 / np.cos([0.262, 0, 0.262]), atol=2e-3
    )
    assert np.array_equal(np.delete(plate, np.r_[sector], axis=1), np.delete(base, np.r_[sector], axis=1))
    with pytest.raises(BadInputError, match=r"hazards\[0\] \(own_parts\): the sector from 50° to 20°"):
        sampled('kind = "own_parts", from_deg = 50, to_deg = 20')


def test_a_vehicle_moves_along_comes_past_or_is_parked() -> None:
    base = sampled()[0]
    along = sampled('kind = "traffic", at_s = 9, for_s = 4, gap_m = 4')[0]  # behind us, where the scanner looks
    within = (base.sweep_s > 9.1) & (base.sweep_s < 12.9)
    np.testing.assert_allclose(along.ranges[within][:, 270], 4.0 - 0.6, atol=0.08)
    assert np.array_equal(along.ranges[~within][:50], base.ranges[~within][:50])
    coming = sampled('kind = "traffic", way = "oncoming", at_s = 7, for_s = 6, aside_m = 1.6')[0]
    beside = np.argmin(np.abs(coming.sweep_s - 10.3))
    right, left = coming.ranges[beside][[2 * 45, 2 * 225]]  # -90° and 90° of a scanner that looks astern
    assert right == pytest.approx(1.6 - 0.7, abs=0.2)  # the vehicle passes on our left
    assert left == pytest.approx(base.ranges[beside][2 * 225], abs=1e-6)


def test_a_parked_vehicle_stands_in_the_run_that_it_is_parked_in() -> None:
    hazard = 'kind = "traffic", way = "parked", run = "there", at_s = 9'
    parked, drive = sampled(hazard)
    place = drive.poses_at(np.array([9.0]))[0]
    box = shapely.affinity.translate(shapely.box(-2, 0.9, 2, 2.3), *place[:2])  # heading along x
    for k in np.flatnonzero((parked.sweep_s > 9) & (parked.sweep_s < 13)):
        x, y, heading = drive.poses_at(parked.sweep_s[k])
        angles = heading + np.pi + np.radians(-135 + 0.5 * np.arange(541))
        origin = np.array([x - 0.6 * np.cos(heading), y - 0.6 * np.sin(heading)])
        points = origin + parked.ranges[k][:, None] * np.column_stack([np.cos(angles), np.sin(angles)])
        hit = parked.ranges[k] != sampled()[0].ranges[k]
        assert hit.sum() > 5
        assert shapely.distance(shapely.points(points[hit]), box).max() < 0.15
    assert changed(hazard, run=1) == set()


def test_a_vehicle_without_room_is_refused_where_its_run_is_named() -> None:
    with pytest.raises(BadInputError, match=r"hazards\[0\] \(traffic\): there is no room for it on the way"):
        sampled('kind = "traffic", way = "parked", run = "there", at_s = 9, aside_m = 0.5')


def test_a_wall_is_moved_out_from_one_run_on() -> None:
    hazard = '[[hazards]]\nkind = "changed_walls"\nrun = "back"\nat = [20, 2]\nlength_m = 6\nby_m = 0.4\n'
    world = parse_world(WORLD.replace("PROFILE", "canmet_trailer") + hazard, "two.toml")
    space = build_space(world, 3)
    before, after = (space_of(run, world, space, 3) for run in world.runs)
    assert before is space
    assert after.area - space.area == pytest.approx(6 * 0.4, rel=0.05)
    added = shapely.box(*shapely.difference(after, space).bounds)
    assert added.bounds == pytest.approx((17, 2.3, 23, 2.7), abs=0.05)
    walls = new_walls(after, space)
    assert np.hypot(*(walls[:, 2:] - walls[:, :2]).T).sum() == pytest.approx(6 + 2 * 0.4, abs=0.1)


def reads_of(hazard: str, epc: str, run: int = 0) -> Array:
    """Where the vehicle was at each reading of a tag, (n, 2)."""
    samples, drive = sampled(hazard, run)
    times = [reading.time_s for reading in samples.readings if reading.epc == epc]
    return drive.poses_at(np.array(times))[:, :2]


def test_stray_reads_are_far_down_the_drift_or_through_rock() -> None:
    away = np.hypot(*(reads_of(f'kind = "far_reads", epc = "{FIRST}"', FIRST) - [18, 1.5]).T)
    assert np.sum(away > 6.0) == 5
    assert np.sum((away > 3.2) & (away <= 6.0)) == 0
    where = reads_of(f'kind = "through_rock", epc = "{FIRST}"', FIRST)
    assert np.sum(where[:, 1] > 10) == 3  # from the drift beside
    assert len(where) == len(reads_of("", FIRST)) + 3


def test_a_dead_tag_is_read_before_and_never_after() -> None:
    hazard = f'kind = "dead_tag", epc = "{SECOND}", run = "back", at_s = 10.3'
    assert changed(hazard, run=0) == set()
    alive = reads_of("", SECOND, run=1)
    assert 0 < len(reads_of(hazard, SECOND, run=1)) < len(alive)
    assert len(reads_of(hazard.replace('"back"', '"there"').replace("10.3", "0"), SECOND, run=1)) == 0
    assert len(reads_of(hazard, FIRST, run=1)) == len(reads_of("", FIRST, run=1))


def test_the_profile_says_more_than_the_truth() -> None:
    wrong = """[[hazards]]
kind = "wrong_mount"
dyaw_deg = 3
dx_m = 0.15
[[hazards]]
kind = "wrong_radii"
wheel = "left_wheel"
factor = 1.02
[[hazards]]
kind = "wrong_track"
factor = 0.96
"""
    world = parse_world(WORLD.replace("PROFILE", "canmet_trailer") + wrong, "two.toml")
    true = true_profile(load_profile("canmet_trailer"), strikes_of(world, world.runs[0], 3))
    mount = true.lasers.primary.mount
    assert (mount.x_m, mount.y_m, mount.yaw_deg) == pytest.approx((-0.75, 0.0, 177.0))
    assert [encoder.wheel_radius_m for encoder in true.encoders] == pytest.approx([0.35 / 1.02, 0.35])
    assert true.vehicle is not None
    assert true.vehicle.track_width_m == pytest.approx(1.6 / 0.96)


def test_a_time_after_the_end_of_the_run_is_refused() -> None:
    message = r"world two: hazards\[0\] \(stuck\): at_s is 900, and run there lasts 38 s"
    with pytest.raises(BadInputError, match=message):
        sampled('kind = "stuck", run = "there", at_s = 900')
