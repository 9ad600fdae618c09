"""A match of two scans of 541 beams of a drive: time and error against the truth, beside small_gicp on the same points.

Pairs of scans up to 1 m apart in a rough mine, the first guess from the wheels; one thread. A match here includes what
each program does to a scan before it can match it, for both scans of a pair: walls and normals, or covariances and a
tree. Andrea Censi's csm, whose matcher is the model of ours, takes 1.03 to 1.1 ms a pair on this kind of machine, and a
third of that is the target.
"""

import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import small_gicp
from table import Figure, report

from processing.geometry import accumulate, compose, inverse, relative
from processing.open_loop import mount_pose, odometry_at_scans
from processing.read_log import read_log
from processing.scan_matching import match_scans
from processing.scan_walls import prepare_scan
from processing.simulation.simulate import simulate
from processing.sweeps import sweeps_of
from processing.tum import read_tum

PAIRS = 400
ROUNDS = 5  # the fastest counts: other programs run on this machine too
MOST_MS = 0.35
GICP_DOWNSAMPLING_M, GICP_NEIGHBOURS, GICP_REACH_M = 0.05, 10, 1.0

Matcher = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]  # points, points, guess → motion


def time_and_errors(match: Matcher, pairs: list[tuple[np.ndarray, np.ndarray, np.ndarray]], true: np.ndarray) -> tuple:
    """ms a pair; rms error in mm and mrad."""
    fastest, motions = np.inf, []
    for _ in range(ROUNDS):
        began = time.process_time()
        motions = [match(*pair) for pair in pairs]
        fastest = min(fastest, (time.process_time() - began) / len(pairs) * 1e3)
    off = relative(true, np.array(motions))
    return fastest, *(1e3 * np.sqrt(np.mean(part**2)) for part in (np.hypot(off[:, 0], off[:, 1]), off[:, 2]))


def with_small_gicp(kind: str) -> Matcher:
    def cloud(points: np.ndarray) -> tuple:
        flat = np.column_stack([points[np.isfinite(points[:, 0])], np.zeros(np.isfinite(points[:, 0]).sum())])
        return small_gicp.preprocess_points(flat.astype(float), GICP_DOWNSAMPLING_M, GICP_NEIGHBOURS)

    def match(reference: np.ndarray, current: np.ndarray, guess: np.ndarray) -> np.ndarray:
        (target, tree), (source, _) = cloud(reference), cloud(current)
        start = np.eye(4)
        c, s = np.cos(guess[2]), np.sin(guess[2])
        start[:2, :2], start[:2, 3] = [[c, -s], [s, c]], guess[:2]
        found = small_gicp.align(
            target, source, tree, start, registration_type=kind, max_correspondence_distance=GICP_REACH_M
        ).T_target_source
        return np.array([found[0, 3], found[1, 3], np.arctan2(found[1, 0], found[0, 0])])

    return match


def main() -> int:
    with tempfile.TemporaryDirectory() as folder:
        world = Path(folder) / "mine"
        simulate("mine_level", world, runs=["west"])
        run = read_log(world / "mine_level-west.mcap")
        stamps, poses = read_tum(world / "mine_level-west.tum")
    odometry, mount = odometry_at_scans(run), mount_pose(run)
    points = sweeps_of(run.scans, odometry, mount).points(slice(None))
    driven, true = accumulate(np.zeros(3), odometry.deltas), poses[np.searchsorted(stamps, run.scans.stamps_ns)]
    rng = np.random.default_rng(1)
    lasts = rng.choice(np.arange(40, len(points)), PAIRS, replace=False)
    firsts = lasts - rng.integers(1, 5, PAIRS)  # up to 1 m at 2.4 m/s

    def as_laser(poses_of: np.ndarray) -> np.ndarray:
        return compose(inverse(mount), compose(relative(poses_of[firsts], poses_of[lasts]), mount))

    guesses, motions = as_laser(driven), as_laser(true)
    pairs = [(points[i], points[j], guess) for i, j, guess in zip(firsts, lasts, guesses, strict=True)]
    setting = run.scans.angle_min, run.scans.angle_increment
    prepared = [(prepare_scan(a, *setting), prepare_scan(b, *setting), guess) for a, b, guess in pairs]
    alone, _, _ = time_and_errors(lambda a, b, guess: match_scans(a, b, guess).motion, prepared, motions)
    ours = time_and_errors(
        lambda a, b, guess: match_scans(prepare_scan(a, *setting), prepare_scan(b, *setting), guess).motion,
        pairs,
        motions,
    )
    figures = [
        Figure("point to line, both scans prepared and matched", ours[0], "ms", most=MOST_MS),
        Figure("the match alone", alone, "ms"),
        Figure("its error along and across", ours[1], "mm"),
        Figure("its error of heading", ours[2], "mrad"),
    ]
    for kind in ("PLANE_ICP", "GICP"):
        theirs = time_and_errors(with_small_gicp(kind), pairs, motions)
        figures += [
            Figure(f"small_gicp {kind}", theirs[0], "ms"),
            Figure("its error along and across", theirs[1], "mm"),
            Figure("its error of heading", theirs[2], "mrad"),
            Figure("our error over its", ours[1] / theirs[1], "", most=1.0),
        ]
    return report(f"a match of two scans of {points.shape[1]} beams, {PAIRS} pairs", figures)


if __name__ == "__main__":
    sys.exit(main())
