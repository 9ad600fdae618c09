"""Weighted least squares of all links between poses (Lu & Milios 1997): sparse Gauss–Newton with a robust cost.

In: poses (N, 3) as a first guess, links between them with their information matrices. Out: the poses that fit the
links best, and how badly each link fits. Pose 0, or those said to be fixed, hold the frame.

The cost of a link is the square of its Mahalanobis distance d up to a corner, and grows no further (Geman–McClure, of
which every cost is the limit: weight (c / (c + d²))²). Only links that say so are doubted: not those of the wheels,
which hold a drive together where a match in its chain was wrong.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from numpy.typing import NDArray

from processing.block_cholesky import (
    Pattern,
    add_product,
    factorise,
    find_pattern,
    inverse_blocks,
    solve_factors,
    whiten,
)
from processing.geometry import relative, relative_jacobians, wrap_angle

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Links:
    """m measured relative poses: pose `ends[:, 1]` as seen from pose `ends[:, 0]`."""

    ends: Ints  # (m, 2)
    motions: Array  # (m, 3)
    informations: Array  # (m, 3, 3)
    robust: NDArray[np.bool_]  # (m,) may be doubted: strong links

    @staticmethod
    def of(ends: Array | Ints, motions: Array, informations: Array, robust: bool) -> "Links":
        count = len(ends)
        return Links(
            np.asarray(ends, np.int64).reshape(count, 2),
            np.asarray(motions, float).reshape(count, 3),
            np.asarray(informations, float).reshape(count, 3, 3),
            np.full(count, robust),
        )

    def __add__(self, other: "Links") -> "Links":
        return join_links([self, other])

    def __getitem__(self, which: NDArray[np.bool_] | Ints) -> "Links":
        return Links(self.ends[which], self.motions[which], self.informations[which], self.robust[which])

    def __len__(self) -> int:
        return len(self.ends)

    def shifted(self, by: int) -> "Links":
        """The same links between poses whose numbers are larger by `by`."""
        return Links(self.ends + by, self.motions, self.informations, self.robust)


def join_links(parts: Sequence[Links]) -> Links:
    """All in a row, one part at least."""
    return Links(
        np.concatenate([part.ends for part in parts]),
        np.concatenate([part.motions for part in parts]),
        np.concatenate([part.informations for part in parts]),
        np.concatenate([part.robust for part in parts]),
    )


NO_LINKS = Links.of(np.empty((0, 2)), np.empty((0, 3)), np.empty((0, 3, 3)), robust=True)


@dataclass(frozen=True, slots=True)
class Solution:
    poses: Array  # (N, 3)
    squared_distances: Array  # (m,) Mahalanobis, of each link
    weights: Array  # (m,) 1 = believed, 0 = doubted
    iterations: int
    converged: bool

    @property
    def chi2(self) -> float:
        return float(self.squared_distances.sum())


CORNER = 16.0  # squared Mahalanobis distance at which a strong link is half doubted: p = 0.001 for three degrees


def residuals(poses: Array, links: Links) -> Array:
    """(m, 3): measured against estimated relative pose, in the frame of the first pose of the link."""
    error = relative(poses[links.ends[:, 0]], poses[links.ends[:, 1]]) - links.motions
    error[:, 2] = wrap_angle(error[:, 2])
    return error


def squared_distances(poses: Array, links: Links) -> Array:
    error = residuals(poses, links)
    return np.asarray(np.einsum("mi,mij,mj->m", error, links.informations, error))


def robust_weights(squares: Array, robust: NDArray[np.bool_], corner: float) -> Array:
    return np.where(robust, (corner / (corner + squares)) ** 2, 1.0)


@dataclass(frozen=True, slots=True)
class NormalEquations:
    """Of the free poses, in the places of a pattern."""

    diagonal: Array  # (n, 3, 3)
    below: Array  # (e, 3, 3)
    gradient: Array  # (n, 3)


def normal_equations(poses: Array, links: Links, weights: Array, pattern: Pattern, slots: Ints) -> NormalEquations:
    """Linearised at `poses` (N, 3); `slots` (m,) are those of the links in the pattern."""
    count = len(pattern)
    out = NormalEquations(np.zeros((count, 3, 3)), np.zeros((len(pattern.rows), 3, 3)), np.zeros((count, 3)))
    _assemble(
        poses,
        links.ends,
        links.motions,
        links.informations,
        weights,
        pattern.place,
        slots,
        out.diagonal,
        out.below,
        out.gradient,
    )
    return out


@njit(cache=True)
def _add_moved(a: Array, b: Array, out: Array) -> None:
    """out += aᵀ b, of a vector b (3,)."""
    for i in range(3):
        out[i] += a[0, i] * b[0] + a[1, i] * b[1] + a[2, i] * b[2]


@njit(cache=True)
def _assemble(
    poses: Array,
    ends: Ints,
    motions: Array,
    informations: Array,
    weights: Array,
    place: Ints,
    slots: Ints,
    diagonal: Array,
    below: Array,
    gradient: Array,
) -> None:
    j_a, j_b, error = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros(3)
    i_a, i_b, pull = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros(3)
    j_a[2, 2], j_b[2, 2] = -1.0, 1.0
    for k in range(len(ends)):
        a, b = ends[k]
        p, q = place[a], place[b]
        if p < 0 and q < 0:
            continue
        c, s = math.cos(poses[a, 2]), math.sin(poses[a, 2])
        dx, dy = poses[b, 0] - poses[a, 0], poses[b, 1] - poses[a, 1]
        x, y = c * dx + s * dy, -s * dx + c * dy
        turn = poses[b, 2] - poses[a, 2] - motions[k, 2]
        error[0], error[1] = x - motions[k, 0], y - motions[k, 1]
        error[2] = turn - 2 * math.pi * round(turn / (2 * math.pi))
        j_b[0, 0], j_b[0, 1], j_b[1, 0], j_b[1, 1] = c, s, -s, c
        j_a[0, 0], j_a[0, 1], j_a[1, 0], j_a[1, 1] = -c, -s, s, -c
        j_a[0, 2], j_a[1, 2] = y, -x
        for i in range(3):
            u, v, w = informations[k, i]
            u, v, w = weights[k] * u, weights[k] * v, weights[k] * w
            pull[i] = u * error[0] + v * error[1] + w * error[2]
            for j in range(3):
                i_a[i, j] = u * j_a[0, j] + v * j_a[1, j] + w * j_a[2, j]
                i_b[i, j] = u * j_b[0, j] + v * j_b[1, j] + w * j_b[2, j]
        if p >= 0:
            add_product(j_a.T, i_a, 1.0, diagonal[p])
            _add_moved(j_a, pull, gradient[p])
        if q >= 0:
            add_product(j_b.T, i_b, 1.0, diagonal[q])
            _add_moved(j_b, pull, gradient[q])
        if slots[k] >= 0:
            if p > q:
                add_product(j_a.T, i_b, 1.0, below[slots[k]])
            else:
                add_product(j_b.T, i_a, 1.0, below[slots[k]])


def solve(
    poses: Array,
    links: Links,
    fixed: NDArray[np.bool_] | None = None,
    corner: float = CORNER,
    max_iterations: int = 30,
) -> Solution:
    """Gauss–Newton with iteratively re-weighted links; a step that makes matters worse is halved.

    `fixed` (N,): poses that stay; by default the first. Every free pose must hang on a fixed one by links.
    """
    poses = np.array(poses, dtype=float)
    if fixed is None:
        fixed = np.zeros(len(poses), bool)
        fixed[0] = True
    pattern = find_pattern(len(poses), links.ends, fixed)
    slots = pattern.slots(links.ends)
    squares = squared_distances(poses, links)
    cost = _cost(squares, links, corner)
    converged, iteration = len(pattern) == 0, 0
    while not converged and iteration < max_iterations:
        iteration += 1
        equations = normal_equations(poses, links, robust_weights(squares, links.robust, corner), pattern, slots)
        if not factorise(pattern, equations.diagonal, equations.below):
            break
        step = -solve_factors(pattern, equations.diagonal, equations.below, equations.gradient)
        for scale in (1.0, 0.5, 0.25, 0.125):
            tried = poses.copy()
            tried[pattern.free] += scale * step
            tried[:, 2] = wrap_angle(tried[:, 2])
            tried_squares = squared_distances(tried, links)
            tried_cost = _cost(tried_squares, links, corner)
            if tried_cost <= cost * (1 + 1e-12):
                break
        converged = bool(np.abs(scale * step).max() < 1e-5 or abs(cost - tried_cost) <= 1e-6 * max(cost, 1e-12))
        if tried_cost <= cost * (1 + 1e-12):
            poses, squares, cost = tried, tried_squares, tried_cost
        else:
            break
    weights = robust_weights(squares, links.robust, corner)
    return Solution(poses, squares, weights, iteration, converged)


def _cost(squares: Array, links: Links, corner: float) -> float:
    return float(np.where(links.robust, corner * squares / (corner + squares), squares).sum())


def boundary_information(poses: Array, links: Links, weights: Array, boundary: Ints) -> Array:
    """Information (3b, 3b) that the links hold about the boundary alone, all other poses eliminated (Schur complement).

    Its null space is the freedom of the frame: only relative poses of the boundary are known.
    """
    count = len(boundary)
    place = np.full(len(poses), -1, np.int64)
    place[boundary] = np.arange(count)
    eliminated = place < 0
    pattern = find_pattern(len(poses), links.ends, ~eliminated)
    equations = normal_equations(poses, links, weights, pattern, pattern.slots(links.ends))
    j_a, j_b = relative_jacobians(poses[links.ends[:, 0]], poses[links.ends[:, 1]])
    weighted = links.informations * weights[:, None, None]
    kept, border = np.zeros((count, count, 3, 3)), np.zeros((len(pattern), count, 3, 3))
    for i, j_i, j, j_j in ((0, j_a, 0, j_a), (0, j_a, 1, j_b), (1, j_b, 0, j_a), (1, j_b, 1, j_b)):
        at_boundary = np.flatnonzero(place[links.ends[:, j]] >= 0)
        row, column = links.ends[at_boundary, i], place[links.ends[at_boundary, j]]
        blocks = np.swapaxes(j_i[at_boundary], 1, 2) @ weighted[at_boundary] @ j_j[at_boundary]
        for matrix, at in ((kept, place[row]), (border, pattern.place[row])):
            used = at >= 0
            np.add.at(matrix, (at[used], column[used]), blocks[used])
    information = kept.swapaxes(1, 2).reshape(3 * count, 3 * count)
    if not len(pattern):
        return information
    if not factorise(pattern, equations.diagonal, equations.below):
        raise np.linalg.LinAlgError("poses hang on nothing")
    sides = border.swapaxes(1, 2).reshape(len(pattern), 3, 3 * count)
    white = whiten(pattern, equations.diagonal, equations.below, sides).reshape(-1, 3 * count)
    return np.asarray(information - white.T @ white)


def marginal_covariances(poses: Array, links: Links, weights: Array, shared: Array | None = None) -> Array:
    """The covariance (N, 3, 3) of every pose as seen from pose 0.

    `shared` (q, m, 3): errors that links have in common, each the change of all motions at one standard deviation.
    """
    fixed = np.zeros(len(poses), bool)
    fixed[0] = True
    out = np.zeros((len(poses), 3, 3))
    pattern = find_pattern(len(poses), links.ends, fixed)
    slots = pattern.slots(links.ends)
    equations = normal_equations(poses, links, weights, pattern, slots)
    if not factorise(pattern, equations.diagonal, equations.below):
        raise np.linalg.LinAlgError("poses hang on nothing")
    out[pattern.free] = inverse_blocks(pattern, equations.diagonal, equations.below)
    predicted = relative(poses[links.ends[:, 0]], poses[links.ends[:, 1]])
    for change in shared if shared is not None else ():
        changed = replace(links, motions=predicted - change)
        gradient = normal_equations(poses, changed, weights, pattern, slots).gradient
        moved = solve_factors(pattern, equations.diagonal, equations.below, gradient)
        out[pattern.free] += moved[:, :, None] * moved[:, None, :]
    return out
