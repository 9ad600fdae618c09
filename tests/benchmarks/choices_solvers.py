"""Solvers on the very same links: those that the map of a run rests on, and those with some false ones among them.

In: recordings, mapped each by itself without tags. Out: a table in Markdown, a row for each solver. All begin at the
open-loop chain. gtsam measures the error of a link along its twist (Logmap), ours component by component: the same but
for links that are far from fulfilled. All figures of cost are by our measure.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import gtsam
import numpy as np
from choices_build import without_kernel

import processing.edge_map
from processing.edge_map import GRADUAL
from processing.evaluation import truth_at
from processing.geometry import align, transform
from processing.graph import build_graph
from processing.open_loop import OpenLoop
from processing.pieces import solve_piece
from processing.pipeline import drive_through, piece_input
from processing.pose_graph import CORNER, Links, solve, squared_distances
from processing.read_log import Run, begin_reading
from processing.ready_runs import make_ready
from processing.relations import read_relations, relation_errors
from processing.scan_matching import match_scans
from processing.trajectory import run_trajectory
from processing.tum import read_tum
from processing.workers import Workers

FALSE_SHARE = 0.01
ROUNDS = 3
HEADER = "| solver | error, m | the same, 1 % of the links false | robust cost | χ² | CPU s |"

Error = Callable[[np.ndarray], float]  # of the poses of the key frames


@dataclass(frozen=True)
class Problem:
    guess: np.ndarray  # (N, 3) open loop
    links: Links
    misled: Links  # the same, with false ones among them
    error_m: Error


def with_ours(guess: np.ndarray, links: Links, corners: tuple[float, ...] = (CORNER,), steps: int = 30) -> np.ndarray:
    for corner in corners:
        guess = solve(guess, links, corner=corner, max_iterations=steps).poses
    return guess


def with_gtsam(guess: np.ndarray, links: Links, optimizer: type) -> tuple[np.ndarray, float]:
    """Poses, and CPU seconds of the optimisation alone: building its graph from Python takes longer."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    kernel = gtsam.noiseModel.mEstimator.GemanMcClure.Create(CORNER**0.5)
    columns = (links.ends.tolist(), links.motions, links.informations, links.robust)
    for (a, b), motion, seen, robust in zip(*columns, strict=True):
        c, s = np.cos(motion[2]), np.sin(motion[2])  # its errors are in the frame at the far end
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        noise = gtsam.noiseModel.Gaussian.Information(turn.T @ seen @ turn)
        noise = gtsam.noiseModel.Robust.Create(kernel, noise) if robust else noise
        graph.add(gtsam.BetweenFactorPose2(a, b, gtsam.Pose2(*motion), noise))
    for k, pose in enumerate(guess):
        values.insert(k, gtsam.Pose2(*pose))
    held = gtsam.noiseModel.Diagonal.Sigmas(np.full(3, 1e-6))
    graph.add(gtsam.PriorFactorPose2(0, gtsam.Pose2(*guess[0]), held))
    began = time.process_time()
    found = optimizer(graph, values).optimize()
    seconds = time.process_time() - began
    poses = (found.atPose2(k) for k in range(len(guess)))
    return np.array([[pose.x(), pose.y(), pose.theta()] for pose in poses]), seconds


SOLVERS: dict[str, Callable[[np.ndarray, Links], np.ndarray | tuple[np.ndarray, float]]] = {
    "ours": with_ours,
    "ours, the robust cost's corner falling": partial(with_ours, corners=GRADUAL),
    "gtsam, Gauss–Newton": partial(with_gtsam, optimizer=gtsam.GaussNewtonOptimizer),
    "gtsam, Levenberg–Marquardt": partial(with_gtsam, optimizer=gtsam.LevenbergMarquardtOptimizer),
    "ours, no robust cost": lambda guess, links: with_ours(guess, without_kernel(links)),
    "gtsam, Gauss–Newton, no robust cost": lambda guess, links: with_gtsam(
        guess, without_kernel(links), gtsam.GaussNewtonOptimizer
    ),
    "one linear step, no robust cost": lambda guess, links: with_ours(guess, without_kernel(links), steps=1),
}


def print_solvers(recordings: list[Path], relations: Path | None = None) -> None:
    """Of several recordings: the error is the rms of theirs, costs and seconds are sums."""
    problems = [problem_of(recording, relations) for recording in recordings]
    loops = ", ".join(str(len(problem.guess)) for problem in problems)
    print(f"Poses: {loops}; links: {', '.join(str(len(problem.links)) for problem in problems)}.\n")
    print(f"{HEADER}\n|{'---|' * HEADER.count(' | ')}---|")
    for name, solver in SOLVERS.items():
        right, wrong, cost, chi2, seconds = [], [], 0.0, 0.0, 0.0
        for problem in problems:
            runs = [_timed(solver, problem.guess, problem.links) for _ in range(ROUNDS)]
            poses, seconds = runs[0][0], seconds + min(run[1] for run in runs)
            squares = squared_distances(poses, problem.links)
            doubted = CORNER * squares / (CORNER + squares)
            cost, chi2 = cost + np.where(problem.links.robust, doubted, squares).sum(), chi2 + squares.sum()
            right.append(problem.error_m(poses))
            wrong.append(problem.error_m(_timed(solver, problem.guess, problem.misled)[0]))
        errors = " | ".join(f"{np.sqrt(np.mean(np.square(of))):.4f}" for of in (right, wrong))
        print(f"| {name} | {errors} | {cost:.1f} | {chi2:.1f} | {seconds:.3f} |", flush=True)
    print()


def _timed(solver: Callable[..., object], guess: np.ndarray, links: Links) -> tuple[np.ndarray, float]:
    began = time.process_time()
    found = solver(guess, links)
    return found if isinstance(found, tuple) else (found, time.process_time() - began)


def problem_of(recording: Path, relations: Path | None) -> Problem:
    """The links that the map of one recording ends with, the doubted ones among them."""
    one_job = Workers(1)
    read = make_ready(begin_reading([recording], None, recording.parent, one_job)(), with_tags=False, work=one_job)
    driven = drive_through(read, one_job, match_scans)
    run, loop = driven[0].run, driven[0].loop
    graph = build_graph([[]], [len(loop)])
    dropped, processing.edge_map.DOUBTED = processing.edge_map.DOUBTED, 0.0
    (solved,) = solve_piece(piece_input("run-0", graph.pieces[0], driven), match_scans)
    processing.edge_map.DOUBTED = dropped
    links, strong = solved.map.links, np.flatnonzero(solved.map.strong)
    rng = np.random.default_rng(len(links))
    false = rng.choice(strong, round(FALSE_SHARE * len(strong)), replace=False)
    motions = links.motions.copy()
    motions[false] = motions[rng.choice(strong, len(false))]  # places that look like others
    if relations is not None:
        error = partial(_relation_error, run, loop, relations)
    else:
        true = truth_at(*read_tum(recording.with_suffix(".tum")), run.scans.stamps_ns[loop.keyframes])
        error = partial(_absolute_error, true[:, :2])
    return Problem(loop.keyframe_poses, links, replace(links, motions=motions), error)


def _relation_error(run: Run, loop: OpenLoop, relations: Path, keyframes: np.ndarray) -> float:
    stamps_ns, poses = run_trajectory(run, loop, keyframes)
    return relation_errors(stamps_ns, poses, read_relations(relations), stamps_ns, poses).translation_mean_m


def _absolute_error(true: np.ndarray, poses: np.ndarray) -> float:
    moved = transform(align(poses[:, :2], true), poses[:, :2])
    return float(np.sqrt(np.mean(np.sum((moved - true) ** 2, axis=1))))
