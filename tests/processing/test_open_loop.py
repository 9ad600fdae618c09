"""The open-loop estimate on simulated drives: against the truth, against the wheels alone, and with failing senses."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from processing.geometry import accumulate, compose, inverse, relative, wrap_angle
from processing.odometry import Motions, dead_reckon
from processing.open_loop import OpenLoop, cut_segments, drive_segment, join_segments, mount_pose, odometry_at_scans
from processing.pipeline import DrivenRun
from processing.read_log import Run, read_log
from processing.read_scans import Scans
from processing.scan_match import ScanMatch
from processing.scan_matching import Matcher, match_scans
from processing.scan_walls import Scan, prepare_scan
from processing.simulation.simulate import simulate
from processing.sweeps import StoredScans, sweeps_of
from processing.tum import read_tum

NOBODY = np.empty(0, np.int64)
SMOOTH = """
schema = 1
name = "smooth"
profile = "canmet_trailer"
drifts = [{ points = [[0, 0], [90, 0]], width_m = 4.5 }]
runs = [{ name = "out", waypoints = [[25, 0], [60, 0]], speed_m_s = 3.0 }]
driving.wander_m = 0.1
noise.slip_m_per_sqrt_m = 0.005
"""


def errors_over(metres: float, poses: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """Root mean square errors [m, rad] of motions over so many metres driven."""
    way = np.append(0.0, np.cumsum(np.hypot(*np.diff(truth[:, :2], axis=0).T)))
    starts = np.flatnonzero(way < way[-1] - metres)
    ends = np.searchsorted(way, way[starts] + metres)
    error = relative(relative(truth[starts], truth[ends]), relative(poses[starts], poses[ends]))
    return float(np.sqrt(np.mean(np.sum(error[:, :2] ** 2, axis=1)))), float(np.sqrt(np.mean(error[:, 2] ** 2)))


def without_laser(run: Run, scans: slice) -> Run:
    """The run with a scanner that saw nothing for a while."""
    ranges = run.scans.ranges.copy()
    ranges[scans] = np.nan
    return replace(run, scans=replace(run.scans, ranges=ranges))


def estimate_open_loop(run: Run, forced: np.ndarray, match: Matcher = match_scans) -> OpenLoop:
    odometry = odometry_at_scans(run)
    sweeps = sweeps_of(run.scans, odometry, mount_pose(run))
    return join_segments(sweeps, odometry, [drive_segment(of, match) for of in cut_segments(sweeps, odometry, forced)])


def first_scans(run: Run, count: int) -> Run:
    s = run.scans
    return replace(run, scans=replace(s, stamps_ns=s.stamps_ns[:count], times=s.times[:count], ranges=s.ranges[:count]))


@pytest.mark.parametrize("clockwise", [False, True])
def test_a_sweep_in_motion_is_straightened(clockwise: bool) -> None:
    """Walls x = 6 and y = ±3, each beam measured from where the scanner is at that moment, also around a curve."""
    mount, angles, seconds = np.array([-0.6, 0.2, np.pi]), np.radians(np.linspace(-135, 135, 541)), 0.1
    sweep_s = 0.04 / 540 * (np.arange(541)[::-1] if clockwise else np.arange(541))
    motion = np.array([0.55, 0.0, 0.08])  # a tenth of a second: 20 km/h in a curve
    ranges = []
    for k in range(3):
        laser = compose(
            compose(accumulate(np.zeros(3), np.tile(motion, (3, 1)))[k], motion * sweep_s[:, None] / seconds), mount
        )
        u, v = np.cos(laser[:, 2] + angles), np.sin(laser[:, 2] + angles)
        with np.errstate(divide="ignore"):
            hits = np.stack([(6 - laser[:, 0]) / u, (3 - laser[:, 1]) / v, (-3 - laser[:, 1]) / v])
        ranges.append(np.where(hits > 0, hits, np.inf).min(axis=0))
    stamps, times = np.arange(3) * 100_000_000, np.arange(3) * seconds
    per_beam = (-1 if clockwise else 1) * 0.04 / 540
    scans = Scans(stamps, times, np.float32(ranges), angles[0], np.radians(0.5), per_beam)
    odometry = Motions(np.tile(motion, (2, 1)), np.tile(np.eye(3), (2, 1, 1)))

    def off_walls(points: np.ndarray) -> float:
        vehicle = accumulate(np.zeros(3), np.tile(motion, (2, 1)))
        laser = compose(vehicle, mount)
        c, s = np.cos(laser[:, 2, None]), np.sin(laser[:, 2, None])
        x = laser[:, 0, None] + c * points[..., 0] - s * points[..., 1]
        y = laser[:, 1, None] + s * points[..., 0] + c * points[..., 1]
        near = np.hypot(points[..., 0], points[..., 1]) < 10
        return float(np.minimum(np.abs(x - 6), np.abs(np.abs(y) - 3))[near].max())

    raw = np.stack([np.float32(ranges) * np.cos(angles), np.float32(ranges) * np.sin(angles)], axis=-1)
    assert off_walls(raw) > 0.1
    assert off_walls(sweeps_of(scans, odometry, mount).points(slice(None))) < 0.01


def test_beams_without_a_range_stay_without(driven: list[DrivenRun]) -> None:
    run = first_scans(driven[0].run, 3)
    ranges = run.scans.ranges.copy()
    ranges[1, 10:13] = [np.nan, np.inf, -np.inf]
    points = sweeps_of(replace(run.scans, ranges=ranges), odometry_at_scans(run), mount_pose(run)).points(slice(None))
    assert np.all(np.isnan(points[1, 10:13]))
    assert np.array_equal(np.isnan(points[..., 0]), ~np.isfinite(ranges))


def test_a_clock_set_back_does_not_bend_the_sweeps(driven: list[DrivenRun]) -> None:
    """Times that were squeezed into a gap would make a hundredfold speed of the motion between them."""
    run, mount = first_scans(driven[0].run, 60), mount_pose(driven[0].run)
    odometry = odometry_at_scans(run)
    times = run.scans.times.copy()
    times[41:50] = times[40] + 1e-4 * np.arange(1, 10)
    squeezed = sweeps_of(replace(run.scans, times=times), odometry, mount).points(slice(None))
    assert np.nanmax(np.abs(squeezed - sweeps_of(run.scans, odometry, mount).points(slice(None)))) < 0.05


def test_without_noise_a_drive_of_200_m_ends_where_it_should(
    driven_clean: list[DrivenRun], truth: list[np.ndarray]
) -> None:
    loop = driven_clean[0].loop
    error = relative(relative(truth[0][0], truth[0][-1]), relative(loop.poses[0], loop.poses[-1]))
    assert np.hypot(*np.diff(truth[0][:, :2], axis=0).T).sum() > 180
    assert np.hypot(*error[:2]) < 0.15
    assert abs(error[2]) < np.radians(0.5)
    assert np.all(loop.matched[1:])


@pytest.mark.parametrize("run", [0, 1])
def test_scans_mend_what_the_wheels_get_wrong(driven: list[DrivenRun], truth: list[np.ndarray], run: int) -> None:
    loop = driven[run].loop
    metres, radians = errors_over(10, loop.poses, truth[run])
    by_wheels, turned_by_wheels = errors_over(10, dead_reckon(loop.odometry), truth[run])
    assert metres < 0.02
    assert radians < np.radians(0.15)
    assert by_wheels > 5 * metres
    assert turned_by_wheels > 3 * radians


def test_the_chain_doubts_itself_as_much_as_it_should(driven: list[DrivenRun], truth: list[np.ndarray]) -> None:
    """NEES of the links of the chain: 3 on average. They may be twice as careful, not half."""
    squares = []
    for of, true in zip(driven, truth, strict=True):
        at = true[of.loop.keyframes]
        error = relative(at[:-1], at[1:]) - of.loop.links.motions
        error[:, 2] = wrap_angle(error[:, 2])
        squares.append(np.einsum("mi,mij,mj->m", error, of.loop.links.informations, error))
    squares = np.concatenate(squares)
    assert 0.3 < squares.mean() < 5
    assert np.quantile(squares, 0.95) < 20


def test_key_frames_are_where_they_are_asked_for_and_where_the_view_changes(driven: list[DrivenRun]) -> None:
    for of in driven:
        loop = of.loop
        assert {found.centre for found in of.passes} <= set(loop.keyframes.tolist())
        assert loop.keyframes[0] == 0
        assert loop.keyframes[-1] == len(loop) - 1
        assert np.all(np.diff(loop.keyframes) > 0)
        assert len(loop.scans) == len(loop.keyframes) == len(loop.links) + 1 == len(loop.wheels) + 1
        steps = np.hypot(*loop.links.motions[:, :2].T)
        assert steps.max() < 1.5
        assert len(steps) < len(loop) / 1.5


def test_every_scan_hangs_on_a_key_frame_before_it(driven: list[DrivenRun]) -> None:
    loop = driven[0].loop
    assert np.all(loop.keyframes[loop.reference] <= np.arange(len(loop)))
    assert np.all(np.diff(loop.reference) >= 0)
    assert_allclose(loop.offsets[loop.keyframes], 0, atol=1e-12)
    assert_allclose(loop.poses[loop.keyframes][:, :2], loop.keyframe_poses[:, :2], atol=1e-9)
    moved = np.array([100.0, -50.0, 2.0])
    elsewhere = loop.place(compose(moved, loop.keyframe_poses))
    assert_allclose(elsewhere[:, :2], compose(moved, loop.poses)[:, :2], atol=1e-9)


def test_wheels_links_are_odometry_alone(driven: list[DrivenRun]) -> None:
    loop = driven[0].loop
    blind = dead_reckon(loop.odometry)[loop.keyframes]
    assert_allclose(loop.wheels.motions[:, :2], relative(blind[:-1], blind[1:])[:, :2], atol=1e-9)
    assert not loop.wheels.robust.any()
    fused, doubted = (
        np.trace(np.linalg.inv(of.informations)[:, :2, :2], axis1=1, axis2=2) for of in (loop.links, loop.wheels)
    )
    assert np.median(doubted / fused) > 3


def test_a_blinded_laser_leaves_the_drive_to_the_wheels(driven: list[DrivenRun], truth: list[np.ndarray]) -> None:
    """Three seconds without a return: the wheels carry on, and say so; then the scans take over again."""
    run, blind = first_scans(driven[0].run, 200), slice(100, 130)
    loop = estimate_open_loop(without_laser(run, blind), NOBODY)
    assert not loop.matched[blind].any()
    assert loop.matched[1:100].all()
    assert loop.matched[135:].all()
    true = relative(truth[0][99], truth[0][140])
    error = relative(true, relative(loop.poses[99], loop.poses[140]))
    driven_m = np.hypot(*np.diff(truth[0][99:141, :2], axis=0).T).sum()
    assert np.hypot(*error[:2]) < 0.03 * driven_m
    across = np.flatnonzero((loop.keyframes[1:] > 100) & (loop.keyframes[1:] <= 131))
    deviations = np.sqrt(np.linalg.inv(loop.links.informations)[:, 0, 0])
    assert deviations[across].max() > 2 * np.median(deviations)
    assert errors_over(5, loop.poses[140:], truth[0][140:200])[0] < 0.02


def test_a_matcher_that_lies_is_not_believed(driven: list[DrivenRun], truth: list[np.ndarray]) -> None:
    """Every seventh match is a metre off and sure of itself: the wheels know better."""
    count = 0

    def liar(reference: Scan, current: Scan, guess: np.ndarray) -> ScanMatch:
        nonlocal count
        count += 1
        found = match_scans(reference, current, guess)
        return replace(found, motion=found.motion + np.array([1.0, 0, 0.3])) if count % 7 == 0 else found

    run = first_scans(driven[0].run, 200)
    loop = estimate_open_loop(run, NOBODY, liar)
    assert count > 200
    assert errors_over(10, loop.poses, truth[0][:200])[0] < 0.05


def drive_smooth(folder: Path, more: str = "") -> tuple[Run, np.ndarray]:
    """The run between smooth walls, and the true pose (n, 3) of every scan."""
    (folder / "smooth.toml").write_text(SMOOTH + more, encoding="utf-8")
    simulate(folder / "smooth.toml", folder / "smooth")
    run = read_log(folder / "smooth" / "smooth-out.mcap")
    stamps, true = read_tum(folder / "smooth" / "smooth-out.tum")
    return run, true[np.searchsorted(stamps, run.scans.stamps_ns)]


def test_along_a_smooth_drift_the_wheels_decide(tmp_path: Path) -> None:
    """35 m of which the laser sees nothing: the length is that of the wheels, not shorter, and its doubt is theirs."""
    run, true = drive_smooth(tmp_path)
    loop = estimate_open_loop(run, NOBODY)
    end, blind = relative(true[0], true[-1]), dead_reckon(loop.odometry)[-1]
    fused, driven_m = loop.poses[-1], end[0]
    assert driven_m > 30
    assert abs(np.hypot(*fused[:2]) - np.hypot(*blind[:2])) < 0.002 * driven_m
    assert abs(np.hypot(*fused[:2]) - driven_m) < 0.005 * driven_m
    assert abs(wrap_angle(fused[2] - end[2])) < np.radians(0.3)  # while the heading is the laser's
    covariances = np.linalg.inv(loop.links.informations)
    wheels = np.linalg.inv(loop.wheels.informations)
    moving = np.hypot(*loop.links.motions[:, :2].T) > 0.3
    assert np.all(covariances[moving, 0, 0] > 0.05 * wheels[moving, 0, 0])
    assert np.all(covariances[moving, 1, 1] < 1e-4)


def test_a_slip_between_smooth_walls_holds_nobody_back(tmp_path: Path) -> None:
    """It bends the sweeps, and bent walls see a motion along the drift: but for the second drive, the vehicle stays."""
    slip = 'hazards = [{ kind = "slip", at_s = 8.0, wheel = "left_wheel", factor = 1.6 }]'
    run, true = drive_smooth(tmp_path, slip)
    moved = relative(relative(true[0], true[-1]), relative(*estimate_open_loop(run, NOBODY).poses[[0, -1]]))
    assert 0.5 < moved[0] < 1.2  # 0.9 m too far, as the wheels counted: no wall contradicts that
    assert abs(moved[2]) < np.radians(0.3)


def test_the_mount_is_that_of_the_profile(driven: list[DrivenRun]) -> None:
    assert_allclose(mount_pose(driven[0].run), [-0.6, 0.0, np.pi])
    assert_allclose(compose(mount_pose(driven[0].run), inverse(mount_pose(driven[0].run))), 0, atol=1e-12)


def test_segments_come_out_as_one_drive_with_key_frames_at_their_ends(
    driven: list[DrivenRun], monkeypatch: pytest.MonkeyPatch
) -> None:
    run = first_scans(driven[0].run, 600)
    whole = estimate_open_loop(run, np.array([70, 200, 333, 400]))
    monkeypatch.setattr("processing.open_loop.SEGMENT_SCANS", 200)
    joined = estimate_open_loop(run, np.array([70, 333]))
    for name in ("keyframes", "reference", "offsets", "matched"):
        np.testing.assert_array_equal(getattr(joined, name), getattr(whole, name))
    for name in ("ends", "motions", "informations", "robust"):
        np.testing.assert_array_equal(getattr(joined.links, name), getattr(whole.links, name))
        np.testing.assert_array_equal(getattr(joined.wheels, name), getattr(whole.wheels, name))
    assert {70, 200, 333, 400, 599} <= set(joined.keyframes.tolist())


def test_stored_scans_are_those_of_their_rows(driven: list[DrivenRun]) -> None:
    loop = estimate_open_loop(first_scans(driven[0].run, 120), NOBODY)
    rows = np.array([3, 4, 50, 119])
    some = StoredScans(loop.sweeps, rows)
    for scan, again, row in zip(some, [some[k] for k in range(4)], rows, strict=True):
        expected = prepare_scan(loop.sweeps.points(slice(None))[row], scan.angle_min, scan.angle_increment)
        for name in ("points", "normals", "variances"):
            np.testing.assert_array_equal(getattr(scan, name), getattr(expected, name))
            np.testing.assert_array_equal(getattr(again, name), getattr(expected, name))
    cut = StoredScans(loop.sweeps.cut(40, 60), np.array([10]))
    np.testing.assert_array_equal(cut[0].points, some[2].points)
    assert len(some[1:3]) == 2
