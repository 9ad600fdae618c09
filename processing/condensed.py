"""What solved pieces know of their boundary, condensed: all their other poses eliminated exactly (Schur complement).

In: a solved piece and which of its poses are its boundary. Out: those poses as a mean and a root of their information;
of many pieces together, what they add to the normal equations of the assembly.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from processing.block_cholesky import Pattern, add_product
from processing.geometry import relative, relative_jacobians, wrap_angle
from processing.pose_graph import Links, NormalEquations, boundary_information

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Condensed:
    """What one piece knows of the relative poses of its boundary: b variables of the assembly."""

    variables: Ints  # (b,)
    local: Array  # (b, 3) in the frame of the piece
    root: Array  # (3b - 3, 3b - 3) R: |R · error|² is the cost of the errors of poses 1 … b-1 seen from pose 0


def condense(poses: Array, links: Links, weights: Array, boundary: Ints, variables: Ints) -> Condensed:
    """Eliminate all poses (N, 3) of a solved piece but the boundary's."""
    local = poses[boundary]
    if len(boundary) < 2:
        return Condensed(variables, local, np.zeros((0, 0)))
    information = boundary_information(poses, links, weights, boundary)[3:, 3:]  # with the first pose held
    _, j_b = relative_jacobians(np.broadcast_to(local[0], local[1:].shape), local[1:])
    turn = np.linalg.inv(j_b)  # blocks on a diagonal
    blocks = information.reshape(len(turn), 3, len(turn), 3)
    seen = np.einsum("iba,ibjc,jcd->iajd", turn, blocks, turn, optimize=True).reshape(information.shape)
    return Condensed(variables, local, np.linalg.cholesky((seen + seen.T) / 2).T)


@dataclass(frozen=True, slots=True)
class Alike:
    """All pieces with b variables, g of them: what is done for one is done for all at once."""

    variables: Ints  # (g, b)
    motions: Array  # (g, b - 1, 3) of poses 1 … b-1 seen from pose 0, as the pieces have them
    roots: Array  # (g, 3b - 3, 3b - 3)
    informations: Array  # (g, 3b - 3, 3b - 3) the squares of the roots

    def errors(self, poses: Array) -> Array:
        """(g, b - 1, 3) of the motions."""
        there = poses[self.variables]
        error = relative(there[:, :1], there[:, 1:]) - self.motions
        error[..., 2] = wrap_angle(error[..., 2])
        return error

    def cost(self, poses: Array) -> float:
        errors = self.errors(poses).reshape(len(self.roots), -1)
        return float(np.square(np.einsum("gij,gj->gi", self.roots, errors)).sum())

    def add_to(self, equations: NormalEquations, pattern: Pattern, poses: Array) -> None:
        """Add what they say to the normal equations."""
        there = poses[self.variables]
        j_a, j_b = relative_jacobians(np.broadcast_to(there[:, :1], there[:, 1:].shape), there[:, 1:])
        count, unknowns = len(there), 3 * self.variables.shape[1]
        normal, gradient = np.zeros((count, unknowns, unknowns)), np.zeros((count, unknowns))
        _square(self.informations, self.errors(poses), j_a, j_b, normal, gradient)
        places = pattern.place[self.variables]
        slots = pattern.slots(self.pairs.reshape(-1, 2)).reshape(len(places), -1)
        _scatter(normal, gradient, places, slots, equations.diagonal, equations.below, equations.gradient)

    @property
    def pairs(self) -> Ints:
        """(g, b (b - 1) / 2, 2) variables of one piece; the later one first."""
        later, earlier = np.tril_indices(self.variables.shape[1], -1)
        return np.stack([self.variables[:, later], self.variables[:, earlier]], axis=2)


@njit(cache=True)
def _square(
    informations: Array,  # (g, 3b - 3, 3b - 3)
    errors: Array,  # (g, b - 1, 3)
    j_a: Array,  # (g, b - 1, 3, 3) of the errors by pose 0
    j_b: Array,  # (g, b - 1, 3, 3) of each error by its own pose
    normal: Array,  # (g, 3b, 3b)
    gradient: Array,  # (g, 3b)
) -> None:
    """Jᵀ I J and Jᵀ I e of every piece, J being blocks on a diagonal beside a first column."""
    seen, product = np.zeros((3, 3)), np.zeros((3, 3))
    for g in range(len(errors)):
        count = errors.shape[1]
        for m in range(count):
            column = slice(3 * m, 3 * m + 3)
            pull = np.zeros(3)
            seen[:] = 0.0  # of pose m by pose 0: Σ_k j_aᵀ I_km
            for k in range(count):
                block = informations[g, 3 * k : 3 * k + 3, column]
                add_product(j_a[g, k].T, block, 1.0, seen)
                for i in range(3):
                    for j in range(3):
                        pull[j] += errors[g, k, i] * block[i, j]
                if k >= m:
                    product[:] = 0.0
                    add_product(block, j_b[g, m], 1.0, product)
                    at = normal[g, 3 * k + 3 : 3 * k + 6, 3 * m + 3 : 3 * m + 6]
                    add_product(j_b[g, k].T, product, 1.0, at)
                    normal[g, 3 * m + 3 : 3 * m + 6, 3 * k + 3 : 3 * k + 6] = at.T
            at = normal[g, :3, 3 * m + 3 : 3 * m + 6]
            add_product(seen, j_b[g, m], 1.0, at)
            normal[g, 3 * m + 3 : 3 * m + 6, :3] = at.T
            add_product(seen, j_a[g, m], 1.0, normal[g, :3, :3])
            for i in range(3):
                for j in range(3):
                    gradient[g, i] += j_a[g, m, j, i] * pull[j]
                    gradient[g, 3 * m + 3 + i] += j_b[g, m, j, i] * pull[j]


@njit(cache=True)
def _scatter(
    normal: Array,  # (g, 3b, 3b)
    gradient: Array,  # (g, 3b)
    places: Ints,  # (g, b) in the order of elimination; -1: fixed
    slots: Ints,  # (g, b (b - 1) / 2)
    diagonal: Array,
    below: Array,
    right: Array,
) -> None:
    for g in range(len(places)):
        pair = -1
        for k in range(places.shape[1]):
            p = places[g, k]
            for i in range(3 if p >= 0 else 0):
                right[p, i] += gradient[g, 3 * k + i]
                for j in range(3):
                    diagonal[p, i, j] += normal[g, 3 * k + i, 3 * k + j]
            for m in range(k):
                pair += 1
                q = places[g, m]
                if p < 0 or q < 0:
                    continue
                high, low = (k, m) if p > q else (m, k)
                for i in range(3):
                    for j in range(3):
                        value = normal[g, 3 * high + i, 3 * low + j]
                        if p != q:
                            below[slots[g, pair], i, j] += value
                        else:  # a run that turned: one pass ends two of the piece's paths
                            diagonal[p, i, j] += value
                            diagonal[p, j, i] += value


def group_alike(pieces: list[Condensed]) -> list[Alike]:
    """Pieces by the number of their variables; what has only one says nothing."""
    sizes: dict[int, list[Condensed]] = {}
    for piece in pieces:
        sizes.setdefault(len(piece.variables), []).append(piece)
    groups = []
    for size, members in sorted(sizes.items()):
        if size > 1:
            local = np.array([piece.local for piece in members])
            variables = np.array([piece.variables for piece in members], np.int64)
            roots = np.array([piece.root for piece in members])
            informations = np.swapaxes(roots, 1, 2) @ roots
            groups.append(Alike(variables, relative(local[:, :1], local[:, 1:]), roots, informations))
    return groups
