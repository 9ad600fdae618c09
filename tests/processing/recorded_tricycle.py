"""A real front-drive tricycle's recording: encoders, and a tracker's poses of its sensor (the public exercise
"Calibration of a real robot": a text file, one record a line, the first guesses in its header).

    time: 1668091584.82 ticks: 290 4294859756 model_pose: 0 0 0 tracker_pose: 6.5e-05 -0.0035 0.00094
                               │   └ drive wheel: counts, as a uint32 that wraps; 5,000 a turn
                               └ steering: where its encoder stands, of 8,192 a turn

Of its first guess the drive wheel's 0.0106 is metres a turn of its encoder, the steering's 0.1 a gear.
"""

import re
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from processing.geometry import compose, relative, wrap_angle
from processing.steering_calibration import MOUNT, Drive, SteeringFit, base_poses, fit_steering

STEERING_COUNTS, DRIVE_COUNTS = 8192, 5000
METRES_A_TURN = 0.0106141
FIRST_GUESS = np.array([0.1, 0.0, METRES_A_TURN / (2 * np.pi), 1.4, 1.5, 0.0, 0.0])
DOUBT = np.array([np.inf, 0.2, 0.3 * FIRST_GUESS[2], 0.5, 0.5, 0.5, 0.3])  # of that guess; of the gear it says nothing
TRACKER = np.diag([0.005, 0.005, 0.002]) ** 2  # m, m, rad: it scatters so while the tricycle stands
STRIDE_M = 0.5  # between two poses that are compared, by the first guess
DEVICE_COUNTS = 1 << 16  # a counter between the encoder and the file is so wide
PACE_S = 1.0  # before and after a pause, to know the pace by
NUMBER = re.compile(r"-?\d+(?:\.\d+)?(?:e[-+]?\d+)?")


@dataclass(frozen=True)
class Recording:
    drive: Drive
    tracker: np.ndarray  # (m, 3) poses of the sensor

    def __len__(self) -> int:
        return len(self.tracker)

    def cut(self, first: int, end: int) -> "Recording":
        drive = Drive(self.drive.times[first:end], self.drive.wheels[first:end], self.drive.axle)
        return Recording(drive, self.tracker[first:end])


def read_tricycle(path: Path) -> Recording:
    lines = [line for line in path.read_text(encoding="utf-8").splitlines() if line.startswith("time:")]
    # Stamp, two counts, the pose by somebody's first guess, the tracker's pose.
    columns = np.array([[float(number) for number in NUMBER.findall(line)] for line in lines])
    times, counts = columns[:, 0] - columns[0, 0], columns[:, 2].astype(np.uint32)
    drive = 2 * np.pi / DRIVE_COUNTS * with_lost_turns(times, count_on(counts))
    steering = wrap_angle(2 * np.pi / STEERING_COUNTS * columns[:, 1])
    return Recording(Drive(times, np.column_stack([drive, steering]), "front"), columns[:, 6:9])


def count_on(counts: np.ndarray) -> np.ndarray:
    """Counts (m,) without the wraps of their uint32, from zero."""
    return np.append(0, np.cumsum(np.diff(counts).astype(np.int32), dtype=np.int64))


def with_lost_turns(times: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Counts (m,) with what was lost in a pause of the bus: the device counts in 16 bits, and when a pause ends after
    more than half of that, its count is taken to have run backwards. The pace around the pause says how far it ran.
    """
    anew = np.append(0, np.flatnonzero(np.diff(counts)) + 1)  # records whose count is new
    found = counts.astype(np.int64)
    for before, after in pairwise(anew.tolist()):
        if after - before > 1:
            first, last = np.searchsorted(times, [times[before] - PACE_S, times[after] + PACE_S])
            window = np.arange(first, last - 8)  # eight records span what comes late
            pace = np.median((counts[window + 8] - counts[window]) / (times[window + 8] - times[window]))
            missing = pace * (times[after] - times[before]) - (counts[after] - counts[before])
            found[after:] += DEVICE_COUNTS * int(np.round(missing / DEVICE_COUNTS))
    return found


def calibrate_tricycle(recording: Recording) -> SteeringFit:
    """By the tracker, from the first guess."""
    way = np.append(0.0, np.cumsum(np.abs(np.diff(recording.drive.wheels[:, 0])))) * FIRST_GUESS[2]
    firsts = np.unique(np.searchsorted(way, np.arange(0.0, way[-1] - STRIDE_M, STRIDE_M / 2)))
    ends = np.column_stack([firsts, np.searchsorted(way, way[firsts] + STRIDE_M)])
    ends = ends[ends[:, 1] < len(way)]
    motions = relative(recording.tracker[ends[:, 0]], recording.tracker[ends[:, 1]])
    covariances = np.tile(TRACKER, (len(ends), 1, 1))
    return fit_steering(recording.drive, recording.drive.times[ends], motions, covariances, FIRST_GUESS, DOUBT)


def sensor_poses(recording: Recording, value: np.ndarray) -> np.ndarray:
    """Dead reckoning with these figures (7,): poses (m, 3)."""
    return compose(base_poses(recording.drive, value, recording.drive.times), value[MOUNT])


def deviations(recording: Recording, value: np.ndarray) -> np.ndarray:
    """How far (m, 3) dead reckoning with these figures (7,) leads off the tracker, from its first pose on."""
    found = sensor_poses(recording, value)
    off = relative(found[0], found) - relative(recording.tracker[0], recording.tracker)
    off[:, 2] = wrap_angle(off[:, 2])
    return off


def relative_deviations(recording: Recording, value: np.ndarray, apart_m: float) -> np.ndarray:
    """The same (k, 3) of stretches of the way, each `apart_m` long by the tracker, from every tenth of that on."""
    way = smooth_way(recording.tracker)
    firsts = np.searchsorted(way, np.arange(0.0, way[-1] - apart_m, apart_m / 10))
    ends = np.column_stack([firsts, np.searchsorted(way, way[firsts] + apart_m).clip(max=len(way) - 1)])
    found = sensor_poses(recording, value)
    moved, true = (relative(poses[ends[:, 0]], poses[ends[:, 1]]) for poses in (found, recording.tracker))
    off = moved - true
    off[:, 2] = wrap_angle(off[:, 2])
    return off


def smooth_way(poses: np.ndarray, every: int = 10) -> np.ndarray:
    """How far (m,) it went, without what the tracker's scatter adds from record to record."""
    steps = np.hypot(*np.diff(poses[::every, :2], axis=0).T)
    knots = np.arange(0, len(poses), every)
    return np.interp(np.arange(len(poses)), knots, np.append(0.0, np.cumsum(steps)))
