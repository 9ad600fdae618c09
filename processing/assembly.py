"""Edge assembly: where the beacons lie, from the lengths of the drifts and the turns between them (paper, section 2.4).

In: a graph of nodes and edges, the length of each edge, measured turns from one edge to another. Out: positions of the
nodes. Its law: an edge has one orientation Θ, that of X_j - X_i for its own order (i, j), whichever way it was driven.

    minimise  Σ weight · wrap(Θ_b - Θ_a - turn)²      eq. (6), Θ_e = atan2(X_j - X_i)     eq. (8)
    subject to  ‖X_j - X_i‖ = L_ij for every edge     eq. (7)

Where the paper takes an interior-point method, this is the method of multipliers (Hestenes 1969; Nocedal & Wright,
section 17.3) on sparse least squares: a spring holds each length, soft at first so that the layout can unfold,
then stiff, and what is still missing is added to its pull until the length holds. Lengths that contradict each other
show themselves, for they stay apart however hard the springs pull; then the compromise by the lengths' variances is
the answer, and the contradiction is named.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

from processing.geometry import wrap_angle

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

TURN_STD_RAD = np.radians(1.0)  # of turns and lengths that come without a weight
LENGTH_STD_M = 0.1
GIVES = (1e-2, 1e-3, 1e-4, *[1e-5] * 20)  # how far the springs that hold the lengths give way, of the mean length
MAX_STEPS = 50  # of Levenberg-Marquardt, for each
SETTLED_M = 1e-6
HELD_M = 1e-3  # lengths that hold to this hold


@dataclass(frozen=True, slots=True)
class Assembly:
    """Where the nodes lie. Each connected part has its frame: its first node at the origin, its first edge along x."""

    positions: Array  # (n, 2) m
    parts: Ints  # (n,) number of the connected part of each node
    violated: list[
        int
    ]  # edges whose lengths contradict each other; then the lengths hold only as their variances allow
    iterations: int
    converged: bool


def turn_from_headings(alpha: Array | float, delta: Array | float, beta: Array | float) -> Array:
    """Θ_b - Θ_a (eq. 5, its signs by geometry) where a drive goes from edge a to edge b.

    The last pose on a has heading Θ_a + α in the world, the first on b has Θ_b + β, and is turned against it by δ:
    Θ_b + β = Θ_a + α + δ. Each heading is in the frame of its edge, whichever way the edge is driven.
    """
    return wrap_angle(np.asarray(alpha) + delta - beta)


def assemble_paper(
    n_nodes: int,
    edges: Ints,  # (m, 2) nodes i, j of each, i != j
    lengths: Array,  # (m,) m, above 0
    turn_edges: Ints,  # (t, 2) edges a, b
    turn_angles: Array,  # (t,) rad, Θ_b - Θ_a
    turn_weights: Array | None = None,  # (t,) 1/rad²; None: all alike, as in the paper
    length_variances: Array | None = None,  # (m,) m²: who gives way where lengths contradict each other
) -> Assembly:
    """Lay out every connected part of the graph by itself."""
    weights = np.full(len(turn_angles), TURN_STD_RAD**-2) if turn_weights is None else turn_weights
    variances = np.full(len(lengths), LENGTH_STD_M**2) if length_variances is None else length_variances
    _, labels = connected_components(_adjacency(n_nodes, edges), directed=False)
    positions, violated, iterations, converged = np.zeros((n_nodes, 2)), [], 0, True
    for part in np.unique(labels[edges[:, 0]]):
        nodes = np.flatnonzero(labels == part)
        mine = np.flatnonzero(labels[edges[:, 0]] == part)
        turns = np.flatnonzero(labels[edges[turn_edges[:, 0], 0]] == part)
        graph = _Part(
            np.searchsorted(nodes, edges[mine]),
            lengths[mine],
            np.searchsorted(mine, turn_edges[turns]),
            turn_angles[turns],
            weights[turns],
        )
        solution = _solve(graph, variances[mine])
        positions[nodes] = _in_own_frame(solution.positions, graph.edges[0])
        violated += mine[solution.violated].tolist()
        iterations, converged = iterations + solution.iterations, converged and solution.converged
    return Assembly(positions, labels.astype(np.int64), violated, iterations, converged)


@dataclass(frozen=True, slots=True)
class _Part:
    """One connected part, nodes and edges counted from 0."""

    edges: Ints  # (m, 2)
    lengths: Array  # (m,)
    turn_edges: Ints  # (t, 2)
    turn_angles: Array  # (t,)
    weights: Array  # (t,)


@dataclass(frozen=True, slots=True)
class _Solution:
    positions: Array
    violated: Ints
    iterations: int
    converged: bool


def _adjacency(n: int, pairs: Ints) -> sparse.csr_array:
    return sparse.csr_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(n, n))


def _in_own_frame(positions: Array, first_edge: Ints) -> Array:
    along = positions[first_edge[1]] - positions[first_edge[0]]
    c, s = along / np.hypot(*along)
    return np.asarray((positions - positions[0]) @ np.array([[c, -s], [s, c]]))


def _solve(part: _Part, variances: Array) -> _Solution:
    positions, offsets, last_gap, iterations = _first_guess(part), np.zeros(len(part.lengths)), np.inf, 0
    for give in GIVES:
        springs = np.full(len(part.lengths), (give * part.lengths.mean()) ** 2)
        positions, steps, converged = _minimise(part, positions, springs, offsets, 1e-6)
        gaps = _residuals(part, positions)[1]
        iterations += steps
        gap = np.abs(gaps).max()
        if gap > max(0.8 * last_gap, HELD_M):  # pulling harder does not close them: there is no such layout
            positions, steps, converged = _minimise(part, positions, variances, 0 * offsets, 1e-9)
            return _Solution(positions, _worst_first(gaps), iterations + steps, converged)
        if gap < SETTLED_M:
            break
        last_gap = gap
        if give == GIVES[-1]:
            offsets = offsets + gaps
    return _Solution(positions, _worst_first(gaps), iterations, converged)


def _worst_first(gaps: Array) -> Ints:
    order = np.argsort(-np.abs(gaps), kind="stable")
    return order[np.abs(gaps)[order] > HELD_M]


def _first_guess(part: _Part) -> Array:
    """Least squares on the turns, then on the edges as vectors.

    Edges that no chain of turns joins form groups; the groups turn against each other so that the edges close best:
    with nodes and turns r of the groups as complex numbers, z_j - z_i = L exp(iΘ) r is linear.
    """
    m, n = len(part.lengths), int(part.edges.max()) + 1
    angles, groups = _spread_turns(part)
    vectors = part.lengths * np.exp(1j * angles)
    rows, unit = np.arange(m), part.lengths.mean()
    incidence = sparse.csc_array(
        (np.r_[np.ones(m), -np.ones(m)], (np.r_[rows, rows], np.r_[part.edges[:, 1], part.edges[:, 0]])), shape=(m, n)
    )
    turned = sparse.csc_array((-vectors, (rows, groups)), shape=(m, groups.max() + 1))
    keep = np.delete(np.arange(n), 0)
    design = sparse.hstack([incidence[:, keep], turned[:, 1:]]).tocsc()
    wanted = np.where(groups == 0, vectors, 0)
    # a group that hangs on one node may turn freely: it stays as it is
    prior = np.r_[np.zeros(n - 1), np.full(groups.max(), 1e-6 * unit**2)]
    normal = (design.conj().T @ design + sparse.diags_array(prior)).tocsc()
    solved = _solve_normal(normal, design.conj().T @ wanted + prior)
    z = np.r_[0, solved[: n - 1]]
    return np.column_stack([z.real, z.imag])


def _spread_turns(part: _Part) -> tuple[Array, Ints]:
    """Orientations (m,) of the edges that fit the turns best, and the group (m,) of edges that turns join.

    First as complex numbers, exp(iΘ_b) = exp(i turn) exp(iΘ_a), which is linear and knows no wrapping; this tells the
    whole turns. Then as angles, whose least squares are those of eq. (6).
    """
    m, (a, b) = len(part.lengths), part.turn_edges.T
    _, groups = connected_components(_adjacency(m, part.turn_edges), directed=False)
    _, first = np.unique(groups, return_index=True)
    free = np.setdiff1d(np.arange(m), first)
    if not len(free):
        return np.zeros(m), groups.astype(np.int64)
    rows, ones = np.tile(np.arange(len(a)), 2), np.ones(len(a))

    def fit(of_a: Array, fixed: Array, wanted: Array) -> Array:
        design = sparse.csc_array((np.r_[ones, -of_a], (rows, np.r_[b, a])), shape=(len(a), m))
        pull = design[:, free].conj().T * part.weights
        fixed[free] += _solve_normal(pull @ design[:, free], pull @ (wanted - design @ fixed))
        return fixed

    pinned = np.zeros(m, complex)
    pinned[first] = 1
    angles = np.angle(fit(np.exp(1j * part.turn_angles), pinned, 0 * ones))
    left = wrap_angle(part.turn_angles - (angles[b] - angles[a]))
    return angles + fit(ones, np.zeros(m), left), groups.astype(np.int64)


def _residuals(part: _Part, positions: Array) -> tuple[Array, Array]:
    """Turns (t,) [rad] and lengths (m,) [m] as laid out, less as measured."""
    d = positions[part.edges[:, 1]] - positions[part.edges[:, 0]]
    angles = np.arctan2(d[:, 1], d[:, 0])
    turned = angles[part.turn_edges[:, 1]] - angles[part.turn_edges[:, 0]]
    return wrap_angle(turned - part.turn_angles), np.hypot(d[:, 0], d[:, 1]) - part.lengths


def _jacobians(part: _Part, positions: Array) -> tuple[sparse.csr_array, sparse.csr_array]:
    """Of the edges' orientations and lengths, each (m, 2n); columns x0, y0, x1, y1 …"""
    m, n = len(part.lengths), len(positions)
    i, j = part.edges[:, 0], part.edges[:, 1]
    d = positions[j] - positions[i]
    length = np.maximum(np.hypot(d[:, 0], d[:, 1]), 1e-3 * part.lengths)  # two nodes that fell together: some direction
    ux, uy = d[:, 0] / length, d[:, 1] / length
    rows = np.tile(np.arange(m), 4)
    columns = np.concatenate([2 * i, 2 * i + 1, 2 * j, 2 * j + 1])
    of_lengths = sparse.csr_array((np.concatenate([-ux, -uy, ux, uy]), (rows, columns)), shape=(m, 2 * n))
    swing = np.concatenate([uy / length, -ux / length, -uy / length, ux / length])  # of atan2
    of_angles = sparse.csr_array((swing, (rows, columns)), shape=(m, 2 * n))
    return of_angles, of_lengths


def _minimise(
    part: _Part, positions: Array, variances: Array, offsets: Array, tolerance: float
) -> tuple[Array, int, bool]:
    """½ Σ weight · turn² + ½ Σ (length gap + offset)² / variance: the layout, the steps taken, whether it settled.

    Levenberg-Marquardt: damped the more the less a step pays. The damping also holds what nothing else holds: the place
    of the whole, and edges that hang free on a node.
    """

    def cost(at: Array) -> float:
        turns, gaps = _residuals(part, at)
        return float(part.weights @ turns**2 + np.sum((gaps + offsets) ** 2 / variances)) / 2

    unit, damping, now = part.lengths.mean(), 1e-6, cost(positions)
    for step in range(1, MAX_STEPS + 1):
        turns, gaps = _residuals(part, positions)
        of_angles, of_lengths = _jacobians(part, positions)
        of_turns = of_angles[part.turn_edges[:, 1]] - of_angles[part.turn_edges[:, 0]]
        pull, push = of_turns.T * part.weights, of_lengths.T / variances
        normal = pull @ of_turns + push @ of_lengths
        scale = max((pull @ of_turns).diagonal().mean(), unit**-2)
        normal = normal + sparse.diags_array(np.full(positions.size, damping * scale))
        move = -_solve_normal(normal, pull @ turns + push @ (gaps + offsets)).reshape(-1, 2)
        if np.abs(move).max() < SETTLED_M:
            return positions, step, True
        after = cost(positions + move)
        if after > now:
            damping *= 10
            continue
        settled = now - after <= tolerance * now
        positions, now, damping = positions + move, after, max(damping / 10, 1e-9)
        if settled:
            return positions, step, True
    return positions, MAX_STEPS, False


def _solve_normal(matrix: sparse.csc_array, right: Array) -> Array:
    """Positive definite normal equations: order of elimination by the pattern, no pivots, a tenth of the usual fill."""
    factors = splu(matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    return factors.solve(right)
