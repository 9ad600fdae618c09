"""The trajectory of a run in the atlas: a pose at every stamp with odometry or a scan.

In: the poses that the pieces give to a run's key frames. Out: stamps and vehicle poses. A scan sits on its key frame; a
sample of the odometry between two scans follows the wheels from the one and is bent to arrive at the other.
"""

import numpy as np
from numpy.typing import NDArray

from processing.edge_placement import Placed
from processing.geometry import accumulate, compose, relative
from processing.odometry import odom_motions, wheel_motions
from processing.open_loop import FOREIGN_NOISE, OpenLoop, interpolate_poses
from processing.read_log import Run

Array = NDArray[np.float64]


def keyframe_poses(placed: list[Placed], run: int, count: int) -> Array:
    """The poses (K, 3) of a run's key frames. Where two pieces share a pass, the one that the run drives into has the
    say.
    """
    poses = np.zeros((count, 3))
    spans = [
        (span.first, piece, p)
        for piece in placed
        for p, span in enumerate(piece.solved.input.piece.spans)
        if span.run == run
    ]
    for _, piece, p in sorted(spans, key=lambda item: item[0]):
        poses[piece.solved.input.paths[p].keyframes] = piece.poses[piece.solved.map.path(p)]
    return poses


def run_trajectory(run: Run, loop: OpenLoop, keyframes: Array) -> tuple[NDArray[np.int64], Array]:
    """Stamps [ns] ascending, and poses (m, 3)."""
    at_scans = loop.place(keyframes)
    driven = drive_blind(run)
    blind = interpolate_poses(run.motion_times, driven, run.scans.times)
    arrives = compose(at_scans[:-1], relative(blind[:-1], blind[1:]))
    missed = np.vstack([relative(arrives, at_scans[1:]), np.zeros(3)])  # after the last scan there is nothing to meet
    lasts = np.append(np.diff(run.scans.times), np.inf)
    k = np.maximum(np.searchsorted(run.scans.times, run.motion_times, side="right") - 1, 0)
    share = np.maximum(run.motion_times - run.scans.times[k], 0.0) / lasts[k]
    after = compose(at_scans[k], relative(blind[k], driven))
    poses = np.concatenate([at_scans, compose(after, missed[k] * share[:, None])])
    stamps = np.concatenate([run.scans.stamps_ns, run.motion_ns])
    stamps, first = np.unique(stamps, return_index=True)
    return stamps, poses[first]


def drive_blind(run: Run) -> Array:
    """Dead reckoning at every sample of the odometry: poses (m, 3)."""
    if run.wheels is not None:
        motions = wheel_motions(run.profile, run.wheels[:, 0], run.wheels[:, 1])
        return accumulate(np.zeros(3), motions.deltas)
    assert run.odometry is not None
    return accumulate(np.zeros(3), odom_motions(run.odometry, FOREIGN_NOISE).deltas)
