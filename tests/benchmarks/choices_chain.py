"""Which scan a scan is matched to, and by what: the open-loop chain alone, before any loop is closed.

In: recordings, with the truth of their runs or relations. Out: a table in Markdown, a row for each.
"""

import time
from pathlib import Path

import numpy as np

import processing.open_loop
from processing.evaluation import Trajectory, match_truth, relative_error
from processing.pipeline import MATCHERS, DrivenRun, drive_through
from processing.read_log import begin_reading
from processing.ready_runs import make_ready
from processing.relations import read_relations, relation_errors
from processing.trajectory import run_trajectory
from processing.tum import read_tum
from processing.workers import Workers

SHIPPED_M = processing.open_loop.KEYFRAME_SPACING_M
SPACINGS_M = {
    "the scan before": 0.0,
    "0.25 m": 0.25,
    f"{SHIPPED_M:g} m, as shipped": SHIPPED_M,
    "1.5 m": 1.5,
    "3 m": 3.0,
}


def print_chains(recordings: list[Path], relations: Path | None = None) -> None:
    """All recordings in one row. Errors are those over 10 m and 100 m of driving, or of the relations."""
    one_job = Workers(1)
    runs = [
        make_ready(begin_reading([path], None, path.parent, one_job)(), with_tags=False, work=one_job)[0]
        for path in recordings
    ]
    measured = "mean error, m | °" if relations is not None else "RPE 10 m, m | RPE 100 m, m | RPE 100 m, °"
    header = f"| key frames | matcher | {measured} | key frames a metre | ms a scan |"
    print(f"{header}\n|{'---|' * (header.count('|') - 1)}")
    for matcher, match in MATCHERS.items():
        for name, spacing_m in SPACINGS_M.items():
            if matcher == "psm" and spacing_m not in (0.0, SHIPPED_M):
                continue
            processing.open_loop.KEYFRAME_SPACING_M = spacing_m
            began = time.process_time()
            driven = drive_through(runs, one_job, match)
            seconds = time.process_time() - began
            errors = _of_relations(driven[0], relations) if relations else _of_truth(driven, recordings)
            keyframes, scans = sum(len(of.loop.keyframes) for of in driven), sum(len(of.loop) for of in driven)
            way_m = sum(float(np.hypot(*of.loop.odometry.deltas[:, :2].T).sum()) for of in driven)
            print(
                f"| {name} | {matcher} | {errors} | {keyframes / way_m:.2f} | {1e3 * seconds / scans:.2f} |", flush=True
            )
    processing.open_loop.KEYFRAME_SPACING_M = SHIPPED_M
    print()


def _of_truth(driven: list[DrivenRun], recordings: list[Path]) -> str:
    found = {
        str(path): match_truth(
            Trajectory(of.run.scans.stamps_ns, of.loop.poses), Trajectory(*read_tum(path.with_suffix(".tum")))
        )
        for of, path in zip(driven, recordings, strict=True)
    }
    near, far = relative_error(found, 10.0), relative_error(found, 100.0)
    assert near is not None
    assert far is not None
    return f"{near.translation_rmse_m:.4f} | {far.translation_rmse_m:.3f} | {far.rotation_rmse_deg:.3f}"


def _of_relations(driven: DrivenRun, relations: Path) -> str:
    stamps_ns, poses = run_trajectory(driven.run, driven.loop, driven.loop.keyframe_poses)
    found = relation_errors(stamps_ns, poses, read_relations(relations), stamps_ns, poses)
    return f"{found.translation_mean_m:.3f} | {found.rotation_mean_deg:.2f}"
