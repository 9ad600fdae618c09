"""Recordings → runs that are ready to be mapped: read, their wheels put right, their passes of tags found.

In: recordings. Out: a `ReadRun` each. Law: what is unfit is refused before anything is read.
"""

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from hw_profiles.errors import BadInputError
from hw_profiles.profile import Profile
from processing.beacons import Pass, find_passes
from processing.calibration import Pairs, WheelScale, calibrate, compare_strides, cut_strides, join_pairs
from processing.odometry import Motions, dead_reckon
from processing.open_loop import mount_pose, odometry_at_scans
from processing.read_log import Run, join_windows, read_window
from processing.recordings import cut_windows, group_parts, survey
from processing.sweeps import Sweeps, sweeps_of
from processing.workers import Workers

MIN_SCANS = 10  # a second


@dataclass(frozen=True, slots=True)
class ReadRun:
    run: Run
    wheels: WheelScale
    odometry: Motions  # n - 1, between scans
    sweeps: Sweeps  # n
    passes: list[Pass]


def read_runs(
    recordings: list[Path], profile: Profile | None, with_tags: bool, scratch: Path, work: Workers
) -> list[ReadRun]:
    """Read them; the ranges of their scans stay in the folder `scratch`.

    Raises:
        BadInputError: a recording is unfit, or it cannot be told which run it is.
        RTLogError: the disk is full, or a process died.
    """
    sources = [survey(parts, profile) for parts in group_parts(recordings)]
    windows = work.map_groups("recordings", partial(read_window, scratch=scratch), map(cut_windows, sources))
    runs = [join_windows(source, read, scratch) for source, read in zip(sources, windows, strict=True)]
    for source, run in zip(sources, runs, strict=True):
        if len(run.scans.times) < MIN_SCANS:
            raise BadInputError(f"{source.parts[0]}: {len(run.scans.times)} scans are too few to map")
    pairs = work.map_groups("wheels", compare_strides, map(cut_strides, runs))
    return [_ready(run, join_pairs(of), with_tags) for run, of in zip(runs, pairs, strict=True)]


def _ready(run: Run, pairs: Pairs, with_tags: bool) -> ReadRun:
    run, wheels = calibrate(run, pairs)
    odometry = odometry_at_scans(run)
    passes: list[Pass] = []
    if with_tags and len(run.tags.epcs):
        nearest = np.searchsorted((run.scans.times[1:] + run.scans.times[:-1]) / 2, run.tags.times)
        passes = find_passes(run.tags.epcs, nearest, dead_reckon(odometry))
    return ReadRun(run, wheels, odometry, sweeps_of(run.scans, odometry, mount_pose(run)), passes)
