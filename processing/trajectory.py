"""The trajectory of a run in the atlas: a pose at every stamp with odometry or a scan.

In: the poses that the pieces give to a run's key frames. Out: stamps and vehicle poses. A scan sits on its key frame; a
sample of the odometry between two scans follows the wheels from the one and is bent to arrive at the other, by as much
of what is missed there as the vehicle has moved of the way.
"""

import numpy as np
from numpy.typing import NDArray

from processing.edge_placement import Placed
from processing.geometry import compose, interpolate_poses, relative
from processing.open_loop import OpenLoop, drive_blind
from processing.read_log import Run

Array = NDArray[np.float64]

LEVER_M = 0.5  # half a track: what a wheel rolls in a turn


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
    moved = travelled(driven, run.motion_times)
    moved_at_scans = np.interp(run.scans.times, run.motion_times, moved)
    between = np.append(np.maximum(np.diff(moved_at_scans), 1e-9), np.inf)

    def poses_at(times: Array) -> Array:
        k = np.maximum(np.searchsorted(run.scans.times, times, side="right") - 1, 0)
        share = np.maximum(np.interp(times, run.motion_times, moved) - moved_at_scans[k], 0.0) / between[k]
        after = compose(at_scans[k], relative(blind[k], interpolate_poses(run.motion_times, driven, times)))
        return compose(after, missed[k] * share[:, None])

    if run.stamped is None:
        poses = np.concatenate([at_scans, poses_at(run.motion_times)])
    else:  # a pose at a stamp is where the vehicle was by that clock, not where it was when a late scan was taken
        poses = np.concatenate([poses_at(run.stamped[0]), poses_at(run.stamped[1])])
    stamps = np.concatenate([run.scans.stamps_ns, run.motion_ns])
    stamps, first = np.unique(stamps, return_index=True)
    return stamps, poses[first]


def travelled(driven: Array, times: Array) -> Array:
    """How far a drive through poses (m, 3) has come at each, in metres with turns counted at LEVER_M.

    What odometry misses between two scans comes with moving, not with time, all the more where stamps come in bursts. A
    millimetre a second makes it rise for a vehicle that stands, too.
    """
    steps = relative(driven[:-1], driven[1:])
    way = np.hypot(steps[:, 0], steps[:, 1]) + LEVER_M * np.abs(steps[:, 2]) + 1e-3 * np.diff(times)
    return np.append(0.0, np.cumsum(way))
