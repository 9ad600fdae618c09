"""The solver against dense least squares, numeric derivatives, graphs whose answer is known, and liars."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import least_squares

from processing.block_cholesky import Pattern, factorise, find_pattern, inverse_blocks, solve_factors
from processing.geometry import accumulate, compose, relative, relative_jacobians, wrap_angle
from processing.pose_graph import (
    CORNER,
    Links,
    boundary_information,
    marginal_covariances,
    normal_equations,
    residuals,
    robust_weights,
    solve,
    squared_distances,
)

N = 30


def random_informations(rng: np.random.Generator, count: int) -> np.ndarray:
    """Positive definite, full: x, y and heading depend on each other."""
    roots = rng.normal(0, 0.7, (count, 3, 3)) + 4 * np.eye(3)
    return roots @ np.swapaxes(roots, 1, 2) * 50


def drive(rng: np.random.Generator, count: int = N) -> np.ndarray:
    """Poses (count, 3) of a winding drive, from a pose that is not zero."""
    motions = np.column_stack([rng.uniform(0.5, 1.5, count - 1), rng.normal(0, 0.1, (count - 1, 2))])
    return accumulate(np.array([3.0, -2.0, 2.8]), motions + np.array([0.0, 0.0, 0.25]))


def chain_ends(count: int = N) -> np.ndarray:
    return np.column_stack([np.arange(count - 1), np.arange(1, count)])


def measure(rng: np.random.Generator, poses: np.ndarray, ends: np.ndarray, noise: float, robust: bool) -> Links:
    """Links between poses, off by `noise` standard deviations."""
    informations = random_informations(rng, len(ends))
    whitener = np.swapaxes(np.linalg.cholesky(informations), 1, 2)
    errors = np.linalg.solve(whitener, rng.normal(0, 1, (len(ends), 3, 1)))[..., 0]
    return Links.of(ends, relative(*poses[ends.T]) + noise * errors, informations, robust)


def network(seed: int, noise: float, strong: int = 25) -> tuple[np.ndarray, Links]:
    """True poses; the chain, and `strong` links between poses taken at random."""
    rng = np.random.default_rng(seed)
    poses = drive(rng)
    pairs = np.array([rng.choice(N, 2, replace=False) for _ in range(strong)])
    return poses, measure(rng, poses, chain_ends(), noise, False) + measure(rng, poses, pairs, noise, True)


def astray(poses: np.ndarray, metres: float, radians: float) -> np.ndarray:
    """A first guess that has the first pose right."""
    guess = poses + np.random.default_rng(9).normal(0, [metres, metres, radians], poses.shape)
    guess[0] = poses[0]
    return guess


def assert_same(a: np.ndarray, b: np.ndarray, atol: float) -> None:
    assert_allclose(a[..., :2], b[..., :2], atol=atol)
    assert_allclose(wrap_angle(a[..., 2] - b[..., 2]), 0, atol=atol)


def robust_cost(poses: np.ndarray, links: Links, corner: float) -> float:
    squares = squared_distances(poses, links)
    return float(np.where(links.robust, corner * squares / (corner + squares), squares).sum())


def dense_hessian(poses: np.ndarray, links: Links, weights: np.ndarray) -> np.ndarray:
    """JᵀΩJ of all poses, written out link by link."""
    full = np.zeros((3 * len(poses), 3 * len(poses)))
    for (a, b), information, weight in zip(links.ends, links.informations, weights, strict=True):
        jacobian = np.zeros((3, 3 * len(poses)))
        jacobian[:, 3 * a : 3 * a + 3], jacobian[:, 3 * b : 3 * b + 3] = relative_jacobians(poses[a], poses[b])
        full += weight * jacobian.T @ information @ jacobian
    return full


def test_the_gradient_is_that_of_the_robust_cost() -> None:
    """½ ∂cost/∂pose by finite differences: proves Jacobians, weights and their bookkeeping at once."""
    poses, links = network(1, noise=2.0)
    poses = astray(poses, 0.05, 0.02)
    fixed = np.zeros(N, bool)
    fixed[[0, 7]] = True
    pattern = find_pattern(N, links.ends, fixed)
    weights = robust_weights(squared_distances(poses, links), links.robust, CORNER)
    gradient = normal_equations(poses, links, weights, pattern, pattern.slots(links.ends)).gradient
    numeric = np.zeros((N, 3))
    for k, c in np.ndindex(N, 3):
        step = np.zeros((N, 3))
        step[k, c] = 1e-6
        numeric[k, c] = (robust_cost(poses + step, links, CORNER) - robust_cost(poses - step, links, CORNER)) / 4e-6
    assert_allclose(gradient, numeric[pattern.free], rtol=1e-5, atol=1e-2)
    assert np.abs(gradient).max() > 10


def test_normal_equations_equal_the_dense_ones() -> None:
    poses, links = network(2, noise=1.0)
    fixed = np.zeros(N, bool)
    fixed[[3, 4]] = True
    weights = np.random.default_rng(3).uniform(0, 1, len(links))
    pattern = find_pattern(N, links.ends, fixed)
    equations = normal_equations(poses, links, weights, pattern, pattern.slots(links.ends))
    free = (3 * pattern.free[:, None] + np.arange(3)).ravel()
    expected = dense_hessian(poses, links, weights)[np.ix_(free, free)]
    assert_allclose(dense_matrix(pattern, equations.diagonal, equations.below), expected, rtol=1e-9, atol=1e-9)


def dense_matrix(pattern: Pattern, diagonal: np.ndarray, below: np.ndarray) -> np.ndarray:
    count = len(pattern)
    full = np.zeros((count, count, 3, 3))
    full[np.arange(count), np.arange(count)] = diagonal
    columns = np.repeat(np.arange(count), np.diff(pattern.first))
    full[pattern.rows, columns] = below
    full[columns, pattern.rows] = np.swapaxes(below, 1, 2)
    return full.swapaxes(1, 2).reshape(3 * count, 3 * count)


@pytest.mark.parametrize("fixed_poses", [[0], [3, 4], list(range(1, N)), list(range(2, N))])
def test_the_sparse_factor_solves_as_a_dense_matrix_does(fixed_poses: list[int]) -> None:
    poses, links = network(5, noise=1.0)
    fixed = np.isin(np.arange(N), fixed_poses)
    pattern = find_pattern(N, links.ends, fixed)
    assert sorted(pattern.free) == np.flatnonzero(~fixed).tolist()
    equations = normal_equations(poses, links, np.ones(len(links)), pattern, pattern.slots(links.ends))
    full = dense_matrix(pattern, equations.diagonal, equations.below)
    diagonal, below = equations.diagonal.copy(), equations.below.copy()
    assert factorise(pattern, diagonal, below)
    right = np.random.default_rng(6).normal(size=(len(pattern), 3))
    assert_allclose(
        solve_factors(pattern, diagonal, below, right).ravel(), np.linalg.solve(full, right.ravel()), rtol=1e-6
    )
    inverse = np.linalg.inv(full).reshape(len(pattern), 3, len(pattern), 3)
    blocks = inverse[np.arange(len(pattern)), :, np.arange(len(pattern))]
    assert_allclose(inverse_blocks(pattern, diagonal, below), blocks, rtol=1e-6, atol=1e-12)


def test_a_matrix_that_is_not_positive_definite_is_refused() -> None:
    poses, links = network(5, noise=1.0)
    pattern = find_pattern(N, links.ends, np.zeros(N, bool))  # nothing holds the frame
    equations = normal_equations(poses, links, np.ones(len(links)), pattern, pattern.slots(links.ends))
    equations.diagonal[len(pattern) // 2] *= -1
    assert not factorise(pattern, equations.diagonal, equations.below)


def test_a_consistent_graph_is_solved_exactly() -> None:
    poses, links = network(4, noise=0.0)
    solution = solve(astray(poses, 0.4, 0.1), links)
    assert solution.converged
    assert_same(solution.poses, poses, 1e-6)
    assert solution.chi2 < 1e-6
    assert_allclose(solution.weights, 1, atol=1e-6)


def test_a_step_too_far_is_halved() -> None:
    """From a guess this poor, the full steps of Gauss–Newton lead away."""
    poses, links = network(4, noise=0.0)
    trusted = Links(links.ends, links.motions, links.informations, np.zeros(len(links), bool))
    guess = poses + np.random.default_rng(7).normal(0, [3.0, 3.0, 0.8], poses.shape)
    guess[0] = poses[0]
    assert_same(solve(guess, trusted).poses, poses, 1e-5)


def test_the_solution_is_that_of_dense_least_squares() -> None:
    poses, links = network(5, noise=1.0)
    links = Links(links.ends, links.motions, links.informations, np.zeros(len(links), bool))
    roots = np.swapaxes(np.linalg.cholesky(links.informations), 1, 2)

    def whitened(x: np.ndarray) -> np.ndarray:
        tried = np.vstack([poses[:1], x.reshape(-1, 3)])
        return np.einsum("mij,mj->mi", roots, residuals(tried, links)).ravel()

    dense = least_squares(whitened, poses[1:].ravel(), xtol=1e-14, ftol=1e-14, gtol=1e-12)
    solution = solve(astray(poses, 0.2, 0.05), links)
    assert_same(solution.poses[1:], dense.x.reshape(-1, 3), 1e-5)
    assert_allclose(solution.chi2, 2 * dense.cost, rtol=1e-6)
    assert_allclose(solution.squared_distances.sum(), solution.chi2)


def test_the_cost_that_is_solved_for_has_the_information_right() -> None:
    """Errors drawn as the links' covariances say: chi squared has as many degrees of freedom as are left."""
    chi2 = []
    for seed in range(20):
        poses, links = network(100 + seed, noise=1.0)
        links = Links(links.ends, links.motions, links.informations, np.zeros(len(links), bool))
        chi2.append(solve(poses, links).chi2)
    freedom = 3 * (len(links) - (N - 1))
    assert_allclose(np.mean(chi2), freedom, rtol=4 * np.sqrt(2 / freedom / 20))


@pytest.mark.parametrize("seed", range(5))
def test_one_link_in_five_that_lies_bends_nothing(seed: int) -> None:
    """The liars are off by metres and agree with each other in none of them; the chain alone is far too weak."""
    poses, links = network(seed, noise=0.3, strong=60)
    rng = np.random.default_rng(seed)
    strong = np.flatnonzero(links.robust)
    liars = rng.choice(strong, 12, replace=False)
    lies = links.motions.copy()
    lies[liars] += rng.choice([-1, 1], (12, 3)) * rng.uniform([1, 1, 0.3], [4, 4, 1.5], (12, 3))
    lied = Links(links.ends, lies, links.informations, links.robust)
    guess = accumulate(poses[0], links.motions[: N - 1])
    honest, doubting = solve(guess, links[np.setdiff1d(np.arange(len(links)), liars)]), solve(guess, lied)
    assert_same(doubting.poses, honest.poses, 0.01)
    assert doubting.weights[liars].max() < 0.1
    assert np.median(doubting.weights[np.setdiff1d(strong, liars)]) > 0.8
    trusting = solve(guess, Links(lied.ends, lies, lied.informations, np.zeros(len(lied), bool)))
    assert np.abs(trusting.poses[:, :2] - honest.poses[:, :2]).max() > 0.3  # they would have


def test_fixed_poses_stay_and_the_others_come_to_them() -> None:
    poses, links = network(6, noise=0.0)
    moved = np.array([10.0, 20.0, 1.0])
    elsewhere = compose(moved, poses)
    fixed = np.zeros(N, bool)
    fixed[[4, 20]] = True
    guess = compose(moved, astray(poses, 0.3, 0.1))
    guess[fixed] = elsewhere[fixed]
    solution = solve(guess, links, fixed)
    assert np.all(solution.poses[fixed] == guess[fixed])
    assert_same(solution.poses, elsewhere, 1e-6)


def test_all_poses_fixed_is_nothing_to_do() -> None:
    poses, links = network(7, noise=1.0)
    solution = solve(poses, links, np.ones(N, bool))
    assert solution.converged
    assert np.all(solution.poses == poses)


def test_another_frame_gives_the_same_answer_in_it() -> None:
    poses, links = network(8, noise=1.0)
    guess, moved = astray(poses, 0.2, 0.05), np.array([-400.0, 70.0, -2.0])
    here, there = solve(guess, links), solve(compose(moved, guess), links)
    assert_same(there.poses, compose(moved, here.poses), 1e-5)
    assert_allclose(there.weights, here.weights, atol=1e-4)


def test_links_across_the_cut_of_the_angle_pull_the_short_way() -> None:
    poses = np.array([[0.0, 0, 0], [1.0, 0, np.pi - 0.01]])
    links = Links.of(np.array([[0, 1]]), np.array([[1.0, 0, -np.pi + 0.01]]), np.eye(3)[None], robust=False)
    assert_allclose(residuals(poses, links)[0], [0, 0, -0.02], atol=1e-12)
    assert_allclose(solve(poses, links).poses[1], [1.0, 0, -np.pi + 0.01], atol=1e-6)


def test_boundary_information_is_the_schur_complement() -> None:
    poses, links = network(9, noise=1.0)
    weights = np.random.default_rng(10).uniform(0.1, 1, len(links))
    boundary = np.array([0, 11, 29, 5])  # in no order: the blocks must come in the order asked for
    full = dense_hessian(poses, links, weights)
    keep = (3 * boundary[:, None] + np.arange(3)).ravel()
    inner = np.setdiff1d(np.arange(3 * N), keep)
    expected = full[np.ix_(keep, keep)] - full[np.ix_(keep, inner)] @ np.linalg.solve(
        full[np.ix_(inner, inner)], full[np.ix_(inner, keep)]
    )
    found = boundary_information(poses, links, weights, boundary)
    assert_allclose(found, expected, atol=1e-6 * np.abs(expected).max())
    values = np.linalg.eigvalsh(found)
    assert_allclose(values[:3], 0, atol=1e-8 * values[-1])  # the freedom of the frame, and no more than it
    assert values[3] > 1e-6 * values[-1]
    everything = boundary_information(poses, links, weights, np.arange(N))
    assert_allclose(everything, full, atol=1e-9 * np.abs(full).max())


def test_marginal_covariances_are_blocks_of_the_dense_inverse() -> None:
    rng = np.random.default_rng(11)
    poses = drive(rng, 130)  # more than the columns that are taken at a time
    links = measure(rng, poses, chain_ends(130), 1.0, False)
    links = links + measure(rng, poses, np.array([[0, 60], [20, 129], [90, 10]]), 1.0, True)
    weights = rng.uniform(0.2, 1, len(links))
    inverse = np.linalg.inv(dense_hessian(poses, links, weights)[3:, 3:])
    found = marginal_covariances(poses, links, weights)
    assert np.all(found[0] == 0)
    for k in range(1, 130):
        at = slice(3 * k - 3, 3 * k)
        assert_allclose(found[k], inverse[at, at], rtol=1e-6, atol=1e-9 * np.abs(inverse).max())


def test_one_pose_without_links_is_solved() -> None:
    none = Links.of(np.empty((0, 2)), np.empty((0, 3)), np.empty((0, 3, 3)), robust=True)
    pose = np.array([[1.0, 2.0, 3.0]])
    assert np.all(solve(pose, none).poses == pose)
    assert_allclose(marginal_covariances(pose, none, np.empty(0)), np.zeros((1, 3, 3)))


def test_links_join_select_and_shift() -> None:
    _, links = network(12, noise=1.0)
    both = links[np.flatnonzero(~links.robust)] + links[links.robust]
    assert len(both) == len(links)
    assert np.all(both.ends == links.ends)
    assert np.all(both.shifted(5).ends == links.ends + 5)
