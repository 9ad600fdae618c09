"""Weighted least squares of all links between poses (Lu & Milios 1997): sparse Gauss–Newton with a robust cost.

In: poses (N, 3) as a first guess, links between them with their information matrices. Out: the poses that fit the
links best, and how badly each link fits. Pose 0, or those said to be fixed, hold the frame.

The cost of a link is the square of its Mahalanobis distance d up to a corner, and grows no further (Geman–McClure, of
which every cost is the limit: weight (c / (c + d²))²). Weak links, the chain of the drive itself, are never doubted.
"""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.linalg import SuperLU, splu

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
        return Links(
            np.concatenate([self.ends, other.ends]),
            np.concatenate([self.motions, other.motions]),
            np.concatenate([self.informations, other.informations]),
            np.concatenate([self.robust, other.robust]),
        )

    def __getitem__(self, which: NDArray[np.bool_] | Ints) -> "Links":
        return Links(self.ends[which], self.motions[which], self.informations[which], self.robust[which])

    def __len__(self) -> int:
        return len(self.ends)

    def shifted(self, by: int) -> "Links":
        """The same links between poses whose numbers are larger by `by`."""
        return Links(self.ends + by, self.motions, self.informations, self.robust)


@dataclass(frozen=True, slots=True)
class Solution:
    poses: Array  # (N, 3)
    squared_distances: Array  # (m,) Mahalanobis, of each link
    weights: Array  # (m,) 1 = believed, 0 = doubted
    chi2: float
    iterations: int
    converged: bool


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


class NormalEquations:
    """The sparse structure of the links, laid out once: filling in numbers is then one scatter."""

    def __init__(self, poses: int, ends: Ints, fixed: NDArray[np.bool_]) -> None:
        self.free = np.flatnonzero(~fixed)
        self.count = len(self.free)
        position = np.full(poses, -1, np.int64)
        position[self.free] = np.arange(self.count)
        a, b = position[ends[:, 0]], position[ends[:, 1]]
        # Four 3 × 3 blocks a link: (a, a), (a, b), (b, a), (b, b).
        rows, columns = np.stack([a, a, b, b], axis=1), np.stack([a, b, a, b], axis=1)
        self.used = (rows >= 0) & (columns >= 0)
        offset = np.arange(3)
        shape = (*rows.shape, 3, 3)
        r = np.broadcast_to((3 * rows)[..., None, None] + offset[:, None], shape)[self.used].ravel()
        c = np.broadcast_to((3 * columns)[..., None, None] + offset[None, :], shape)[self.used].ravel()
        size = 3 * self.count
        key, self.slot = np.unique(c * size + r, return_inverse=True)
        self.rows = (key % size).astype(np.int32)
        self.pointers = np.searchsorted(key // size, np.arange(size + 1)).astype(np.int32)
        self.ends_ab = np.stack([a, b], axis=1)

    def matrix(self, j_a: Array, j_b: Array, informations: Array) -> sp.csc_matrix:
        ia, ib = informations @ j_a, informations @ j_b
        ta, tb = np.swapaxes(j_a, 1, 2), np.swapaxes(j_b, 1, 2)
        blocks = np.stack([ta @ ia, ta @ ib, tb @ ia, tb @ ib], axis=1)
        data = np.bincount(self.slot, weights=blocks[self.used].ravel(), minlength=len(self.rows))
        size = 3 * self.count
        return sp.csc_matrix((data, self.rows, self.pointers), shape=(size, size))

    def gradient(self, j_a: Array, j_b: Array, informations: Array, error: Array) -> Array:
        weighted = np.einsum("mij,mj->mi", informations, error)
        out = np.zeros((self.count + 1, 3))  # the last row takes what belongs to fixed poses
        np.add.at(out, self.ends_ab[:, 0], np.einsum("mji,mj->mi", j_a, weighted))
        np.add.at(out, self.ends_ab[:, 1], np.einsum("mji,mj->mi", j_b, weighted))
        return out[:-1].ravel()


def factorise(matrix: sp.csc_matrix) -> SuperLU:
    """Sparse factors of a symmetric positive definite matrix."""
    return splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})


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
    equations = NormalEquations(len(poses), links.ends, fixed)
    squares = squared_distances(poses, links)
    cost = _cost(squares, links, corner)
    converged, iteration = equations.count == 0, 0
    while not converged and iteration < max_iterations:
        iteration += 1
        j_a, j_b = relative_jacobians(poses[links.ends[:, 0]], poses[links.ends[:, 1]])
        weighted = links.informations * robust_weights(squares, links.robust, corner)[:, None, None]
        gradient = equations.gradient(j_a, j_b, weighted, residuals(poses, links))
        step = -factorise(equations.matrix(j_a, j_b, weighted)).solve(gradient).reshape(-1, 3)
        for scale in (1.0, 0.5, 0.25, 0.125):
            tried = poses.copy()
            tried[equations.free] += scale * step
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
    return Solution(poses, squares, weights, float(squares.sum()), iteration, converged)


def _cost(squares: Array, links: Links, corner: float) -> float:
    return float(np.where(links.robust, corner * squares / (corner + squares), squares).sum())


def boundary_information(poses: Array, links: Links, weights: Array, boundary: Ints) -> Array:
    """Information (3b, 3b) that the links hold about the boundary alone, all other poses eliminated (Schur complement).

    Its null space is the freedom of the frame: only relative poses of the boundary are known.
    """
    j_a, j_b = relative_jacobians(poses[links.ends[:, 0]], poses[links.ends[:, 1]])
    equations = NormalEquations(len(poses), links.ends, np.zeros(len(poses), bool))
    full = equations.matrix(j_a, j_b, links.informations * weights[:, None, None])
    keep = (3 * boundary[:, None] + np.arange(3)).ravel()
    inner = np.setdiff1d(np.arange(full.shape[0]), keep)
    if len(inner) == 0:
        return np.asarray(full.toarray()[np.ix_(keep, keep)])
    border = full[inner][:, keep].toarray()
    eliminated = factorise(full[inner][:, inner].tocsc()).solve(border)
    return np.asarray(full[keep][:, keep].toarray() - border.T @ eliminated)


def marginal_covariances(poses: Array, links: Links, weights: Array) -> Array:
    """The covariance (N, 3, 3) of every pose as seen from pose 0."""
    j_a, j_b = relative_jacobians(poses[links.ends[:, 0]], poses[links.ends[:, 1]])
    fixed = np.zeros(len(poses), bool)
    fixed[0] = True
    out = np.zeros((len(poses), 3, 3))
    if len(poses) == 1:
        return out
    equations = NormalEquations(len(poses), links.ends, fixed)
    factors = factorise(equations.matrix(j_a, j_b, links.informations * weights[:, None, None]))
    for first in range(0, equations.count, 100):  # columns of the inverse, some at a time: it is dense
        last = min(first + 100, equations.count)
        unit = np.zeros((3 * equations.count, 3 * (last - first)))
        unit[3 * first : 3 * last] = np.eye(3 * (last - first))
        columns = factors.solve(unit)[3 * first : 3 * last].reshape(last - first, 3, last - first, 3)
        out[1 + first : 1 + last] = columns[np.arange(last - first), :, np.arange(last - first), :]
    return out
