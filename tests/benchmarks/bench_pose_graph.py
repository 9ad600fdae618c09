"""The pose-graph solver beside gtsam: the same links, the same first guess, one thread.

Worlds of streets as in M3500 and city10000 (Olson 2006, Kaess et al. 2007): a drive along the blocks of a town, with
links to what was seen there before. The first guess lays the links out along a spanning tree.
"""

import sys
import time
from collections import deque

import gtsam
import numpy as np
from scipy.spatial import cKDTree
from table import Figure, report

from processing.geometry import compose, inverse, relative, wrap_angle
from processing.pose_graph import Links, solve

SIZES = ((3500, 5600), (10000, 20700))
SIGMAS = np.array([0.05, 0.05, 0.02])  # m, m, rad
ROUNDS = 3
MOST_TIMES = 2.0


def drive_through_town(count: int, links: int) -> tuple[np.ndarray, Links]:
    """True poses (count, 3), a metre apart, and noisy links between them."""
    rng = np.random.default_rng(count)
    side, place, heading = int(np.sqrt(count) * 0.55), np.zeros(2, int), 0
    steps = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])
    true = np.empty((count, 3))
    for k in range(count):
        heading = (heading + rng.choice([-1, 0, 0, 0, 1])) % 4
        while not np.all((place + steps[heading] >= 0) & (place + steps[heading] < side)):
            heading = (heading + rng.choice([-1, 1])) % 4
        true[k] = [*place, wrap_angle(heading * np.pi / 2)]
        place = place + steps[heading]
    met = np.array(sorted(cKDTree(true[:, :2]).query_pairs(1.5)))
    met = met[met[:, 1] - met[:, 0] > 10]
    chain = np.column_stack([np.arange(count - 1), np.arange(1, count)])
    ends = np.concatenate([chain, met[rng.permutation(len(met))[: links - len(chain)]]])
    motions = compose(relative(true[ends[:, 0]], true[ends[:, 1]]), rng.normal(0, SIGMAS, (len(ends), 3)))
    return true, Links.of(ends, motions, np.tile(np.diag(SIGMAS**-2), (len(ends), 1, 1)), robust=False)


def lay_out(start: np.ndarray, count: int, links: Links) -> np.ndarray:
    """Poses along the links of a spanning tree, breadth first."""
    joined: list[list[tuple[int, np.ndarray]]] = [[] for _ in range(count)]
    for (a, b), motion in zip(links.ends.tolist(), links.motions, strict=True):
        joined[a].append((b, motion))
        joined[b].append((a, inverse(motion)))
    poses, seen, waiting = np.zeros((count, 3)), {0}, deque([0])
    poses[0] = start
    while waiting:
        a = waiting.popleft()
        for b, motion in joined[a]:
            if b not in seen:
                poses[b] = compose(poses[a], motion)
                seen.add(b)
                waiting.append(b)
    return poses


def with_gtsam(guess: np.ndarray, links: Links, levenberg: bool) -> tuple[float, float]:
    """CPU seconds of the optimisation alone, and chi squared."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    noise = gtsam.noiseModel.Diagonal.Sigmas(SIGMAS)
    for (a, b), motion in zip(links.ends.tolist(), links.motions, strict=True):
        graph.add(gtsam.BetweenFactorPose2(a, b, gtsam.Pose2(*motion), noise))
    for k, pose in enumerate(guess):
        values.insert(k, gtsam.Pose2(*pose))
    held = gtsam.noiseModel.Diagonal.Sigmas(np.full(3, 1e-6))
    graph.add(gtsam.PriorFactorPose2(0, gtsam.Pose2(*guess[0]), held))
    method = gtsam.LevenbergMarquardtOptimizer if levenberg else gtsam.GaussNewtonOptimizer
    began = time.process_time()
    found = method(graph, values).optimize()
    return time.process_time() - began, 2 * graph.error(found)


def with_ours(guess: np.ndarray, links: Links) -> tuple[float, float]:
    began = time.process_time()
    found = solve(guess, links)
    return time.process_time() - began, found.chi2


def main() -> int:
    figures = []
    for count, size in SIZES:
        true, links = drive_through_town(count, size)
        guess = lay_out(true[0], count, links)
        with_ours(guess, links)  # loads what is compiled
        ours, newton, levenberg = (
            min(runs)
            for runs in zip(
                *(
                    (with_ours(guess, links), with_gtsam(guess, links, False), with_gtsam(guess, links, True))
                    for _ in range(ROUNDS)
                ),
                strict=True,
            )
        )
        name = f"{count} poses, {len(links)} links: "
        figures += [
            Figure(f"{name}ours", ours[0], "s"),
            Figure(f"{name}gtsam Gauss-Newton", newton[0], "s"),
            Figure(f"{name}gtsam Levenberg-Marquardt", levenberg[0], "s"),
            Figure(f"{name}ours over the faster", ours[0] / min(newton[0], levenberg[0]), "", most=MOST_TIMES),
            Figure(f"{name}chi squared over theirs", ours[1] / min(newton[1], levenberg[1]), "", most=1.0001),
        ]
    return report("pose graphs beside gtsam", figures)


if __name__ == "__main__":
    sys.exit(main())
