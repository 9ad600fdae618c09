"""Runs as they were read → runs ready to be driven through: what the profile and the stamps say put right, their passes
of tags found.

In: runs. Out: a `ReadyRun` each.
"""

from dataclasses import dataclass

import numpy as np

from processing.beacons import Pass, find_passes
from processing.calibration import WheelScale, calibrate, compare_strides, cut_strides, join_pairs
from processing.odometry import Motions, dead_reckon
from processing.open_loop import mount_pose, odometry_at_scans
from processing.read_log import Run
from processing.sensor_calibration import LaserPairs, calibrate_sensor
from processing.sweeps import Sweeps, sweeps_of
from processing.wheel_turns import calibrate_turns, tell_turns
from processing.workers import Workers


@dataclass(frozen=True, slots=True)
class ReadyRun:
    run: Run
    wheels: WheelScale
    put_right: list[str]  # what the profile or the stamps said wrongly
    odometry: Motions  # n - 1, between scans
    sweeps: Sweeps  # n
    passes: list[Pass]


def make_ready(runs: list[Run], with_tags: bool, work: Workers) -> list[ReadyRun]:
    """Put right what is wrong, and find their passes."""
    pairs = work.map_groups("wheels", compare_strides, map(cut_strides, runs))
    return [_ready(run, join_pairs(of), with_tags) for run, of in zip(runs, pairs, strict=True)]


def _ready(run: Run, pairs: LaserPairs, with_tags: bool) -> ReadyRun:
    run, put_right = calibrate_sensor(run, pairs)
    before = run.profile
    run, motions, found = calibrate_turns(run, pairs)
    run, wheels = calibrate(run, motions)
    put_right += tell_turns(before, run.profile, found, wheels.sigma)
    odometry = odometry_at_scans(run)
    passes: list[Pass] = []
    if with_tags and len(run.tags.epcs):
        nearest = np.searchsorted((run.scans.times[1:] + run.scans.times[:-1]) / 2, run.tags.times)
        passes = find_passes(run.tags.epcs, nearest, dead_reckon(odometry))
    sweeps = sweeps_of(run.scans, odometry, mount_pose(run))
    return ReadyRun(run, wheels, put_right, odometry, sweeps, passes)
