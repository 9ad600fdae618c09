"""What the wheels of a run count wrongly everywhere must not average away in the covariances."""

import numpy as np
import pytest

from processing.chain import GATE
from processing.edge_map import PieceMap
from processing.pose_graph import Links, marginal_covariances, solve
from processing.shared_errors import scale_errors

STEPS, NOISE_M, SIGMA = 100, 0.01, 0.002


def straight(seen_m: float, first: int = 0) -> Links:
    """A drive of STEPS metres: fused links that see the way to `seen_m`, and those of the wheels."""
    ends = np.column_stack([np.arange(STEPS), np.arange(1, STEPS + 1)]) + first
    motions = np.tile([1.0, 0.0, 0.0], (STEPS, 1))
    fused = 1 / (1 / NOISE_M**2 + 1 / seen_m**2)
    chain = Links.of(ends, motions, np.tile(np.diag([1 / fused, 1e6, 1e8]), (STEPS, 1, 1)), robust=True)
    wheels = np.tile(np.diag([1 / (GATE * NOISE_M**2), 1e2, 1e2]), (STEPS, 1, 1))
    return chain + Links.of(ends, motions, wheels, robust=False)


def end_variance(links: Links, firsts: list[int], runs: list[int]) -> float:
    poses = np.column_stack([np.arange(firsts[-1]) % (STEPS + 1), np.zeros((firsts[-1], 2))])
    piece = PieceMap(poses, np.array(firsts), links, solve(poses, links))
    shared = scale_errors(piece, np.array(runs), np.full(len(runs), SIGMA))
    return float(marginal_covariances(poses, links, np.ones(len(links)), shared)[STEPS, 0, 0])


def test_where_only_wheels_see_the_way_their_error_grows_with_the_way_not_its_root() -> None:
    independent = STEPS * NOISE_M**2 / (1 + 1 / GATE)
    assert end_variance(straight(100.0), [0, STEPS + 1], [0]) == pytest.approx(
        independent + (SIGMA * STEPS) ** 2, rel=0.01
    )


def test_where_the_laser_sees_the_way_the_wheels_hardly_matter() -> None:
    sure = end_variance(straight(0.001), [0, STEPS + 1], [0])
    assert sure < STEPS * 0.001**2 + (0.05 * SIGMA * STEPS) ** 2


def test_two_drives_of_one_run_err_alike_and_those_of_two_runs_do_not() -> None:
    both = straight(100.0) + straight(100.0, first=STEPS + 1)
    joined = Links.of(
        [[0, STEPS + 1], [STEPS, 2 * STEPS + 1]], np.zeros((2, 3)), np.tile(np.eye(3) * 1e8, (2, 1, 1)), True
    )
    firsts = [0, STEPS + 1, 2 * STEPS + 2]
    alike, apart = (end_variance(both + joined, firsts, runs) for runs in ([0, 0], [0, 1]))
    assert alike - apart == pytest.approx((SIGMA * STEPS) ** 2 / 2, rel=0.02)
