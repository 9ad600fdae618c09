"""What profile and stamps say wrongly is found where the drive shows it; nothing is claimed where all is right."""

from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from numpy.testing import assert_allclose

from processing.calibration import compare_strides, cut_strides, join_pairs
from processing.pipeline import DrivenRun
from processing.read_log import Run, read_log
from processing.sensor_calibration import LaserPairs, calibrate_sensor, fit_sensor
from processing.simulation.simulate import simulate

WORLD = """
schema = 1
name = "bends"
seed = 3
profile = "canmet_trailer"
walls.roughness_m = 0.2
drifts = [{ points = [[0, 0], [30, 0], [36, 24], [64, 30], [70, 2], [100, 0]], width_m = 4.6 }]
runs = [{ name = "through", waypoints = [[6, 0], [30, 0], [36, 24], [64, 30], [70, 2], [94, 0]], speed_m_s = 2.0 }]
"""


@pytest.fixture(scope="module")
def bends(tmp_path_factory: pytest.TempPathFactory) -> tuple[Run, LaserPairs]:
    """A drive through five bends, and its laser's motions between pairs of scans."""
    folder = tmp_path_factory.mktemp("bends")
    (folder / "bends.toml").write_text(WORLD, encoding="utf-8")
    simulate(folder / "bends.toml", folder / "bends")
    run = read_log(Path(folder / "bends" / "bends-through.mcap"))
    return run, join_pairs([compare_strides(strides) for strides in cut_strides(run)])


def with_mount(run: Run, x_m: float, y_m: float, yaw_deg: float) -> Run:
    """The run with a profile whose scanner sits so far from where it is."""
    lasers = run.profile.lasers
    at = lasers.primary.mount
    mount = msgspec.structs.replace(at, x_m=at.x_m + x_m, y_m=at.y_m + y_m, yaw_deg=at.yaw_deg + yaw_deg)
    primary = msgspec.structs.replace(lasers.primary, mount=mount)
    return replace(
        run, profile=msgspec.structs.replace(run.profile, lasers=msgspec.structs.replace(lasers, primary=primary))
    )


def test_nothing_is_claimed_of_a_right_profile(bends: tuple[Run, LaserPairs]) -> None:
    run, told = calibrate_sensor(*bends)
    assert told == []
    assert run is bends[0]


def test_of_a_drive_with_little_to_see_nothing_is_claimed(bends: tuple[Run, LaserPairs]) -> None:
    run, pairs = bends
    few = LaserPairs(pairs.ends[:10], pairs.motions[:10], pairs.covariances[:10])
    assert not fit_sensor(with_mount(run, 0.0, 0.0, 3.0), few).used.any()


@pytest.mark.parametrize("yaw_deg", [-3.0, 2.0])
def test_a_scanner_turned_in_its_mount_is_found(bends: tuple[Run, LaserPairs], yaw_deg: float) -> None:
    fit = fit_sensor(with_mount(bends[0], 0.0, 0.15, yaw_deg), bends[1])
    assert fit.used[1:3].all()
    assert_allclose(np.degrees(fit.off[2]), -yaw_deg, atol=0.2)
    assert_allclose(fit.off[1], -0.15, atol=0.05)
    run, told = calibrate_sensor(with_mount(bends[0], 0.0, 0.15, yaw_deg), bends[1])
    assert_allclose(run.profile.lasers.primary.mount.yaw_deg, 180, atol=0.2)
    assert len(told) == int(fit.used.sum())


@pytest.mark.parametrize("late_s", [0.06, -0.06])
def test_what_is_late_is_moved_and_the_stamps_are_kept(bends: tuple[Run, LaserPairs], late_s: float) -> None:
    """Stamps are late, never early: those of the scans, or those of the odometry."""
    run = bends[0]
    true = run.scans.times, run.motion_times
    scans, motions = (true[0] + late_s, true[1]) if late_s > 0 else (true[0], true[1] - late_s)
    late = replace(run, scans=replace(run.scans, times=scans), motion_times=motions)
    found, told = calibrate_sensor(late, bends[1])
    (line,) = told
    whose, off = line.split(" stamps off by ")
    assert whose == ("the scans'" if late_s > 0 else "the odometry's")
    assert float(off.split(" ±")[0]) == pytest.approx(60, abs=15)  # ms late, whoever it is
    assert_allclose(found.scans.times, true[0], atol=0.015)
    assert_allclose(found.motion_times, true[1], atol=0.015)
    assert found.stamped is not None
    assert_allclose(found.stamped[0], scans)
    assert_allclose(found.stamped[1], motions)


def test_a_slipping_wheel_is_no_wrong_mount(driven: list[DrivenRun], bends: tuple[Run, LaserPairs]) -> None:
    run = bends[0]
    assert run.wheels is not None
    wheels = run.wheels.copy()
    for start in (200, 500):
        slipped = np.diff(wheels[start : start + 11, 0]) * 0.6
        wheels[start + 1 : start + 11, 0] += np.cumsum(slipped)
        wheels[start + 11 :, 0] += slipped.sum()
    assert calibrate_sensor(replace(run, wheels=wheels), bends[1])[1] == []
