"""The trajectory of a run: on its scans where the map has them, by odometry between and beyond."""

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
from numpy.typing import NDArray

from hw_profiles.profile import load_profile
from processing.geometry import compose, relative, wrap_angle
from processing.odometry import Motions
from processing.open_loop import OpenLoop
from processing.pose_graph import Links
from processing.read_log import Run, TagReadings
from processing.read_scans import Scans
from processing.sweeps import Sweeps
from processing.trajectory import run_trajectory

EPOCH_NS = 1_767_592_800 * 10**9
NO_LINKS = Links.of(np.zeros((0, 2)), np.zeros((0, 3)), np.zeros((0, 3, 3)), robust=True)


def true_pose(t: NDArray[np.float64]) -> NDArray[np.float64]:
    """2 m/s on a circle of 10 m."""
    angle = 0.2 * np.asarray(t)
    return np.column_stack([10 * np.sin(angle), 10 * (1 - np.cos(angle)), wrap_angle(angle)])


def ns(t: NDArray[np.float64]) -> NDArray[np.int64]:
    return EPOCH_NS + np.round(np.asarray(t) * 1e9).astype(np.int64)


def a_run(
    scan_t: NDArray[np.float64], motion_t: NDArray[np.float64], odometry: NDArray[np.float64] | None = None
) -> tuple[Run, OpenLoop]:
    """A run and what open loop keeps of it, every scan a key frame; `odometry` (m, 3), by default the true one."""
    count = len(scan_t)
    scans = Scans(ns(scan_t), scan_t, np.full((count, 2), np.nan, np.float32), 0.0, 0.1, 0.0)
    run = Run(
        run_id="circle",
        sha256="",
        profile=load_profile("canmet_trailer"),
        scans=scans,
        scan_ticks=np.arange(count),
        epoch_ns=EPOCH_NS,
        motion_ns=ns(motion_t),
        motion_times=motion_t,
        wheels=None,
        odometry=true_pose(motion_t) if odometry is None else odometry,
        tags=TagReadings(np.zeros(0), np.zeros(0, np.str_)),
        ticks=count,
    )
    loop = OpenLoop(
        odometry=Motions(np.zeros((count - 1, 3)), np.zeros((count - 1, 3, 3))),
        sweeps=Sweeps(
            np.zeros((count, 2), np.float32), np.zeros(count), np.zeros((count, 3)), np.zeros(3), 0.0, 0.1, 0.0
        ),
        keyframes=np.arange(count),
        links=NO_LINKS,
        wheels=NO_LINKS,
        reference=np.arange(count),
        offsets=np.zeros((count, 3)),
        matched=np.ones(count, bool),
        contradictions=[],
    )
    return run, loop


def assert_poses(actual: NDArray[np.float64], expected: NDArray[np.float64], atol: float = 1e-9) -> None:
    assert_allclose(actual[:, :2], expected[:, :2], atol=atol)
    assert_allclose(wrap_angle(actual[:, 2] - expected[:, 2]), 0, atol=atol)


def test_every_stamp_is_there_once_and_they_rise() -> None:
    scan_t = np.arange(0.03, 5, 0.1)
    motion_t = np.arange(0, 5.2, 0.07)  # some stamps in common
    run, loop = a_run(scan_t, motion_t)
    stamps, poses = run_trajectory(run, loop, true_pose(scan_t))
    assert len(stamps) < len(scan_t) + len(motion_t)
    assert set(stamps.tolist()) == {*ns(scan_t).tolist(), *ns(motion_t).tolist()}
    assert np.all(np.diff(stamps) > 0)
    assert poses.shape == (len(stamps), 3)


def test_scans_lie_where_the_map_has_them() -> None:
    scan_t, motion_t = np.arange(0.03, 5, 0.1), np.arange(0, 5, 0.1)
    run, loop = a_run(scan_t, motion_t)
    mapped = true_pose(scan_t) + np.random.default_rng(3).normal(0, 0.3, (len(scan_t), 3))
    stamps, poses = run_trajectory(run, loop, mapped)
    assert_poses(poses[np.searchsorted(stamps, run.scans.stamps_ns)], mapped, atol=1e-15)


def test_a_sample_at_the_stamp_of_a_scan_has_its_pose() -> None:
    scan_t = np.arange(0.0, 2, 0.1)
    run, loop = a_run(scan_t, scan_t.copy())
    mapped = compose(np.array([3.0, -1.0, 0.4]), true_pose(scan_t))
    stamps, poses = run_trajectory(run, loop, mapped)
    assert_array_equal(stamps, ns(scan_t))
    assert_poses(poses, mapped, atol=1e-15)


def test_true_odometry_on_true_scans_is_the_truth_everywhere() -> None:
    scan_t, motion_t = np.arange(1.0, 8, 1.0), np.arange(0, 9, 0.05)  # starts before the scans, ends after them
    run, loop = a_run(scan_t, motion_t)
    atlas = np.array([100.0, -50.0, 2.5])
    stamps, poses = run_trajectory(run, loop, compose(atlas, true_pose(scan_t)))
    assert_poses(poses, compose(atlas, true_pose((stamps - EPOCH_NS) * 1e-9)), atol=1e-7)


def test_between_scans_it_is_bent_to_arrive() -> None:
    scan_t, motion_t = np.array([0.0, 1.0, 2.0]), np.arange(0, 2.01, 0.01)
    straight = np.column_stack([motion_t, np.zeros((len(motion_t), 2))])  # what the wheels say: 1 m/s along x
    mapped = np.array([[0.0, 0.0, 0.0], [1.1, 0.2, 0.1], [2.2, 0.5, 0.3]])  # what the map says
    run, loop = a_run(scan_t, motion_t, straight)
    _, poses = run_trajectory(run, loop, mapped)
    assert_poses(poses[[0, 100, 200]], mapped)
    steps = np.hypot(*np.diff(poses[:, :2], axis=0).T)
    assert steps.max() < 0.013  # no jump: the error is spread
    assert_poses(poses[[50]], np.array([[0.55, 0.1, 0.05]]), atol=1e-9)


def test_beyond_the_scans_odometry_carries_on_from_the_nearest() -> None:
    scan_t, motion_t = np.array([1.0, 2.0, 3.0]), np.arange(0, 5, 0.1)
    mapped = np.array([[5.0, 5.0, 1.0], [6.0, 6.0, 1.5], [6.0, 7.0, 2.5]])  # nothing like the odometry
    run, loop = a_run(scan_t, motion_t)
    stamps, poses = run_trajectory(run, loop, mapped)
    t = (stamps - EPOCH_NS) * 1e-9
    before, after = t < 1.0, t > 3.0
    assert before.sum() == 10
    assert after.sum() == 19
    first, last = true_pose(np.array([1.0])), true_pose(np.array([3.0]))
    assert_poses(poses[before], compose(mapped[0], relative(first, true_pose(t[before]))), atol=1e-6)
    assert_poses(poses[after], compose(mapped[2], relative(last, true_pose(t[after]))), atol=1e-6)


def test_scans_between_key_frames_go_with_theirs() -> None:
    scan_t = np.arange(0.0, 1, 0.1)
    run, loop = a_run(scan_t, scan_t.copy())
    true = true_pose(scan_t)
    reference = np.array([0, 0, 0, 0, 0, 1, 1, 1, 1, 1])
    sparse = OpenLoop(
        odometry=loop.odometry,
        sweeps=loop.sweeps,
        keyframes=np.array([0, 5]),
        links=NO_LINKS,
        wheels=NO_LINKS,
        reference=reference,
        offsets=relative(true[[0, 5]][reference], true),
        matched=loop.matched,
        contradictions=[],
    )
    moved = compose(np.array([1.0, 2.0, -3.0]), true)
    _, poses = run_trajectory(run, sparse, moved[[0, 5]])
    assert_poses(poses, moved, atol=1e-12)


def test_stamps_that_run_backwards_are_kept_and_sorted() -> None:
    scan_t, motion_t = np.arange(0.0, 2, 0.1), np.arange(0.0, 2, 0.05)
    run, loop = a_run(scan_t, motion_t)
    run.motion_ns[20] -= 500_000_001
    stamps, poses = run_trajectory(run, loop, true_pose(scan_t))
    assert np.all(np.diff(stamps) > 0)
    assert set(stamps.tolist()) == {*run.scans.stamps_ns.tolist(), *run.motion_ns.tolist()}
    assert np.isfinite(poses).all()


def test_what_odometry_misses_is_made_up_for_where_the_vehicle_moved() -> None:
    """It stands, drives a metre within a twentieth of a second by stamps that come in a burst, and stands again."""
    motion_t = np.array([0.0, 0.5, 0.9, 0.95, 1.5, 2.0])
    odometry = np.zeros((6, 3))
    odometry[3:, 0] = 1.0
    run, loop = a_run(np.array([0.0, 2.0]), motion_t, odometry)
    _, poses = run_trajectory(run, loop, np.array([[0.0, 0.0, 0.0], [1.1, 0.0, 0.0]]))  # a tenth more than counted
    assert_allclose(poses[:, 0], [0.0, 0.0, 0.0, 1.1, 1.1, 1.1], atol=5e-4)
    _, still = run_trajectory(
        *a_run(np.array([0.0, 2.0]), motion_t, np.zeros((6, 3))), np.array([[0.0] * 3, [0.1, 0, 0]])
    )
    assert_allclose(still[:, 0], 0.05 * motion_t, atol=1e-9)  # nothing to go by but time
