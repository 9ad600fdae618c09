"""Edge assembly: layouts that are known, the paper's interior-point method as the judge, contradictions named."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import NonlinearConstraint, minimize

from processing.assembly import Assembly, _jacobians, _Part, _residuals, assemble_paper, turn_from_headings
from processing.geometry import align, compose, relative, transform, wrap_angle

Network = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def measure(
    nodes: np.ndarray, edges: np.ndarray, turn_edges: np.ndarray, noise_rad: float = 0.0, seed: int = 0
) -> Network:
    """True nodes, edges, lengths, turn edges and turns with noise."""
    d = nodes[edges[:, 1]] - nodes[edges[:, 0]]
    angles = np.arctan2(d[:, 1], d[:, 0])
    turns = angles[turn_edges[:, 1]] - angles[turn_edges[:, 0]]
    noise = np.random.default_rng(seed).normal(0, noise_rad, len(turns))
    return nodes, edges, np.hypot(d[:, 0], d[:, 1]), turn_edges, wrap_angle(turns + noise)


def grid(size: int, noise_rad: float, seed: int = 1, share: float = 0.6) -> Network:
    """A crooked grid of drifts, edges either way round, and turns between some of the edges that meet."""
    rng = np.random.default_rng(seed)
    index = np.arange(size * size).reshape(size, size)
    nodes = np.argwhere(index >= 0) * 60.0 + rng.normal(0, 8, (size * size, 2))
    across, along = np.stack([index[:-1], index[1:]], -1), np.stack([index[:, :-1], index[:, 1:]], -1)
    edges = rng.permuted(rng.permutation(np.vstack([across.reshape(-1, 2), along.reshape(-1, 2)])), axis=1)
    meeting = [np.flatnonzero((edges == node).any(axis=1)) for node in range(len(nodes))]
    pairs = [(a, b) for group in meeting for k, a in enumerate(group) for b in group[k + 1 :] if rng.random() < share]
    return measure(nodes, edges, np.array(pairs), noise_rad, seed)


def laid_out(network: Network, **options: np.ndarray) -> Assembly:
    nodes, *measured = network
    return assemble_paper(len(nodes), *measured, **options)


def gaps(assembly: Assembly, network: Network) -> np.ndarray:
    ends = assembly.positions[network[1]]
    return np.hypot(*(ends[:, 1] - ends[:, 0]).T) - network[2]


def error(assembly: Assembly, network: Network) -> float:
    return float(np.hypot(*(transform(align(assembly.positions, network[0]), assembly.positions) - network[0]).T).max())


def turn_cost(positions: np.ndarray, network: Network) -> float:
    _, edges, _, turn_edges, turns = network
    d = positions[edges[:, 1]] - positions[edges[:, 0]]
    angles = np.arctan2(d[:, 1], d[:, 0])
    return float(np.sum(wrap_angle(angles[turn_edges[:, 1]] - angles[turn_edges[:, 0]] - turns) ** 2))


SQUARE = np.array([[0.0, 0.0], [80.0, 0.0], [80.0, 60.0], [0.0, 60.0]])
AROUND = np.array([[0, 1], [1, 2], [2, 3], [0, 3]])  # the last edge is driven from 3 to 0, against its order
CHAIN = np.array([[0, 1], [1, 2], [2, 3], [3, 0]])


def test_a_square_in_its_own_frame() -> None:
    assembly = laid_out(measure(SQUARE, AROUND, CHAIN))
    assert_allclose(assembly.positions, SQUARE, atol=1e-6)
    assert assembly.converged
    assert assembly.violated == []


def test_turn_from_headings_whichever_way_the_edges_are_driven() -> None:
    """Poses on the way from edge a to edge b, in the frames of both, for the four pairs of driving directions."""
    nodes = np.array([[0.0, 0.0], [50.0, 10.0], [70.0, 60.0]])
    last, first = np.array([49.9, 10.0, 0.7]), np.array([50.1, 10.2, 0.8])
    for a in ((0, 1), (1, 0)):
        for b in ((1, 2), (2, 1)):
            # an edge frame: its origin at the edge's first node, x towards the second
            frames = [np.array([*nodes[i], np.arctan2(*(nodes[j] - nodes[i])[::-1])]) for i, j in (a, b)]
            alpha, beta = relative(frames[0], last)[2], relative(frames[1], first)[2]
            turn = turn_from_headings(alpha, relative(last, first)[2], beta)
            assert_allclose(wrap_angle(turn - (frames[1][2] - frames[0][2])), 0, atol=1e-12)
            assert_allclose(compose(frames[1], relative(frames[1], first)), first, atol=1e-12)


def test_a_triangle_forgets_turns_that_its_lengths_forbid() -> None:
    network = measure(SQUARE[:3], np.array([[0, 1], [1, 2], [0, 2]]), np.array([[0, 1], [1, 2]]), noise_rad=0.1)
    assembly = laid_out(network)
    assert error(assembly, network) < 1e-5
    assert np.abs(gaps(assembly, network)).max() < 1e-5


def test_nested_loops_from_perfect_measurements() -> None:
    network = grid(6, noise_rad=0.0)
    assert error(laid_out(network), network) < 1e-6


def test_noise_spreads_over_the_loops() -> None:
    network = grid(8, noise_rad=0.02)
    assembly = laid_out(network)
    assert np.abs(gaps(assembly, network)).max() < 1e-6
    assert error(assembly, network) < 1.0
    assert np.sqrt(turn_cost(assembly.positions, network) / len(network[4])) < 0.02


@pytest.mark.parametrize("seed", [3, 4])
def test_poor_turns_do_not_fold_the_layout(seed: int) -> None:
    """12 degrees of noise in every turn: along a spanning tree they add up to a layout that is folded over."""
    network = grid(20, noise_rad=0.2, seed=seed)
    assembly = laid_out(network)
    assert assembly.converged
    assert assembly.violated == []
    assert error(assembly, network) < 20


@pytest.mark.filterwarnings("ignore:delta_grad:UserWarning")  # the oracle's, at its end
@pytest.mark.parametrize("noise_rad", [0.02, 0.1])
def test_is_the_minimum_that_an_interior_point_method_finds(noise_rad: float) -> None:
    network = grid(3, noise_rad)
    nodes, edges, lengths, _, _ = network

    def length_gaps(x: np.ndarray) -> np.ndarray:
        ends = x.reshape(-1, 2)[edges]
        return np.hypot(*(ends[:, 1] - ends[:, 0]).T) - lengths

    oracle = minimize(
        lambda x: turn_cost(x.reshape(-1, 2), network),
        nodes.ravel(),
        method="trust-constr",
        constraints=NonlinearConstraint(length_gaps, 0, 0),
        options={"gtol": 1e-9, "xtol": 1e-12, "maxiter": 2000},
    )
    assembly = laid_out(network)
    judged = oracle.x.reshape(-1, 2)
    assert np.abs(length_gaps(oracle.x)).max() < 1e-6
    assert_allclose(turn_cost(assembly.positions, network), turn_cost(judged, network), rtol=1e-4)
    assert_allclose(transform(align(assembly.positions, judged), assembly.positions), judged, atol=0.01)


def test_jacobians_equal_their_numeric_twins() -> None:
    nodes, *rest = grid(3, 0.1)
    part, step = _Part(*rest, np.ones(len(rest[3]))), 1e-5
    of_angles, of_lengths = _jacobians(part, nodes)
    of_turns = of_angles[part.turn_edges[:, 1]] - of_angles[part.turn_edges[:, 0]]
    for which, analytic in enumerate((of_turns, of_lengths)):
        for k in range(nodes.size):
            shift = np.zeros(nodes.size)
            shift[k] = step
            plus, minus = (_residuals(part, nodes + sign * shift.reshape(-1, 2))[which] for sign in (1, -1))
            assert_allclose(analytic.toarray()[:, k], (plus - minus) / (2 * step), atol=1e-7)


def test_a_tree_is_what_its_turns_say() -> None:
    nodes = np.array([[0.0, 0.0], [30.0, 0.0], [50.0, 20.0], [50.0, -40.0], [90.0, 20.0]])
    network = measure(nodes, np.array([[0, 1], [1, 2], [3, 1], [2, 4]]), np.array([[0, 1], [0, 2], [1, 3]]))
    assembly = laid_out(network)
    assert_allclose(assembly.positions, nodes, atol=1e-6)


def test_drives_that_no_turn_joins_are_held_by_the_loops() -> None:
    """Two runs, each a chain of its own: only the closing of the loop says how they lie to each other."""
    network = measure(SQUARE, AROUND, np.array([[0, 1], [2, 3]]))
    assembly = laid_out(network)
    assert assembly.converged
    assert error(assembly, network) < 1e-3


def test_parts_have_frames_of_their_own() -> None:
    nodes = np.vstack([SQUARE, SQUARE[::-1] + 500, [[7.0, 7.0]]])  # the last is a node without any edge
    edges, turns = np.vstack([AROUND[::-1], AROUND + 4]), np.vstack([CHAIN, CHAIN + 4])
    assembly = laid_out(measure(nodes, edges, turns))
    assert assembly.parts.tolist() == [0, 0, 0, 0, 1, 1, 1, 1, 2]
    assert_allclose(assembly.positions[0], 0, atol=1e-9)
    assert_allclose(assembly.positions[3], [60, 0], atol=1e-6)  # the first edge, 0 to 3, lies along x
    assert_allclose(assembly.positions[4:6], [[0, 0], [80, 0]], atol=1e-6)
    assert_allclose(assembly.positions[8], 0)


def test_one_edge_and_no_turn() -> None:
    assembly = assemble_paper(2, np.array([[1, 0]]), np.array([12.0]), np.zeros((0, 2), int), np.zeros(0))
    assert_allclose(assembly.positions, [[0, 0], [-12, 0]], atol=1e-9)


def test_lengths_that_contradict_each_other_are_named_and_share_the_gap_by_their_variances() -> None:
    """A triangle of 10, 10 and 25 m beside a sound square."""
    nodes = np.vstack([[[0.0, 0.0], [10.0, 0.0], [20.0, 0.1]], SQUARE + 100])
    network = measure(
        nodes, np.vstack([[[0, 1], [1, 2], [0, 2]], AROUND + 3]), np.vstack([[[0, 1]], CHAIN + 3]), noise_rad=0.001
    )
    network[2][2] = 25.0
    variances = np.array([0.01, 0.01, 0.04, 1, 1, 1, 1])
    assembly = laid_out(network, turn_weights=np.full(5, 0.1), length_variances=variances)
    assert sorted(assembly.violated) == [0, 1, 2]
    assert_allclose(gaps(assembly, network)[:3], [5 / 6, 5 / 6, -10 / 3], atol=0.05)
    assert np.abs(gaps(assembly, network)[3:]).max() < 1e-5


def test_two_drifts_of_different_length_between_two_nodes() -> None:
    edges = np.array([[0, 1], [0, 1], [1, 2]])
    assembly = assemble_paper(3, edges, np.array([50.0, 52.0, 30.0]), np.array([[0, 2]]), np.array([0.5]))
    assert sorted(assembly.violated) == [0, 1]
    assert_allclose(np.hypot(*assembly.positions[1]), 51.0, atol=0.01)


def test_a_false_length_is_named_first() -> None:
    nodes, edges = np.random.default_rng(3).uniform(0, 100, (6, 2)), np.argwhere(np.triu(np.ones((6, 6)), 1))
    network = measure(nodes, edges, np.column_stack([np.arange(14), np.arange(1, 15)]), 0.001)
    network[2][5] += 40.0
    assert laid_out(network).violated[0] == 5


def test_thousands_of_edges() -> None:
    network = grid(25, noise_rad=0.02)
    assembly = laid_out(network)
    assert assembly.converged
    assert assembly.violated == []
    assert error(assembly, network) < 2.0
