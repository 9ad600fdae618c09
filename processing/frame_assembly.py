"""Assembly beyond the paper: pieces as relative poses of their boundary, with full covariance, in one small pose graph.

In: each piece, solved by itself in its own frame. Out: the poses of its boundary, the passes of tags above all, in
one frame.

    piece A  ●━━━━━━━━━●              ● boundary: a pass belongs to the piece before it and to the piece after it, and
                       ●━━━━━━● B     joins them rigidly; the rest of a piece is eliminated exactly (Schur complement),
           pass shared by A and B     so what is left is small, and to solve it is to solve the whole network

Where pieces overlap without sharing a pass (two passes of one tag in different pieces, two edges before the same
junction), links between their key frames join them; those key frames then belong to the boundary too.
"""

from dataclasses import dataclass
from heapq import heappop, heappush
from itertools import count

import numpy as np
from numba import njit
from numpy.typing import NDArray

from processing.block_cholesky import Pattern, factorise, find_pattern, solve_factors
from processing.geometry import compose, inverse, relative, relative_jacobians, wrap_angle
from processing.pose_graph import (
    CORNER,
    Links,
    NormalEquations,
    boundary_information,
    normal_equations,
    robust_weights,
    squared_distances,
)

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


GRADUAL = (1e4, 1e3, 1e2, CORNER)


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
class _Alike:
    """All pieces with b variables, g of them: what is done for one is done for all at once."""

    variables: Ints  # (g, b)
    motions: Array  # (g, b - 1, 3) of poses 1 … b-1 seen from pose 0, as the pieces have them
    roots: Array  # (g, 3b - 3, 3b - 3)

    def errors(self, poses: Array) -> Array:
        """(g, 3b - 3), whitened."""
        there = poses[self.variables]
        error = relative(there[:, :1], there[:, 1:]) - self.motions
        error[..., 2] = wrap_angle(error[..., 2])
        return np.asarray(np.einsum("gij,gj->gi", self.roots, error.reshape(len(error), -1)))

    def jacobians(self, poses: Array) -> Array:
        """(g, 3b - 3, 3b) of the same."""
        there = poses[self.variables]
        j_a, j_b = relative_jacobians(np.broadcast_to(there[:, :1], there[:, 1:].shape), there[:, 1:])
        count, size = self.roots.shape[:2]
        columns = self.roots.reshape(count, size, -1, 3)
        first = np.einsum("gikc,gkcd->gid", columns, j_a)
        others = np.einsum("gikc,gkcd->gikd", columns, j_b).reshape(count, size, -1)
        return np.concatenate([first, others], axis=2)

    def add_to(self, equations: NormalEquations, pattern: Pattern, poses: Array) -> None:
        """Add what they say to the normal equations."""
        jacobians = self.jacobians(poses)
        normal = np.swapaxes(jacobians, 1, 2) @ jacobians
        gradient = np.einsum("gij,gi->gj", jacobians, self.errors(poses))
        places = pattern.place[self.variables]
        slots = pattern.slots(self.pairs.reshape(-1, 2)).reshape(len(places), -1)
        _scatter(normal, gradient, places, slots, equations.diagonal, equations.below, equations.gradient)

    @property
    def pairs(self) -> Ints:
        """(g, b (b - 1) / 2, 2) variables of one piece; the later one first."""
        later, earlier = np.tril_indices(self.variables.shape[1], -1)
        return np.stack([self.variables[:, later], self.variables[:, earlier]], axis=2)


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


def _group(pieces: list[Condensed]) -> list[_Alike]:
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
            groups.append(_Alike(variables, relative(local[:, :1], local[:, 1:]), roots))
    return groups


def solve_frames(
    first_guess: Array, pieces: list[Condensed], links: Links, fixed: NDArray[np.bool_], max_iterations: int = 50
) -> tuple[Array, Array]:
    """Poses (V, 3) of all variables, and the weight (m,) of each link between pieces. Damped Gauss–Newton.

    With falling corners (graduated non-convexity): a loop that comes back a metre off is closed by its links, which
    agree, before any of them is doubted. `fixed` (V,): one variable of each connected part, at least.
    """
    poses, groups = first_guess, _group(pieces)
    ends = np.concatenate([links.ends, *(group.pairs.reshape(-1, 2) for group in groups)])
    pattern = find_pattern(len(poses), ends, fixed)
    for corner in GRADUAL if np.any(links.robust) else (CORNER,):
        poses = _minimise(poses, groups, links, pattern, corner, max_iterations)
    return poses, robust_weights(squared_distances(poses, links), links.robust, CORNER)


def _minimise(
    first_guess: Array, groups: list[_Alike], links: Links, pattern: Pattern, corner: float, max_iterations: int
) -> Array:
    poses, cost, damping = first_guess.copy(), _cost(first_guess, groups, links, corner), 0.0
    for _ in range(max_iterations if len(pattern) else 0):
        tried = _step(poses, groups, links, pattern, corner, damping)
        tried_cost = np.inf if tried is None else _cost(tried, groups, links, corner)
        if tried is not None and tried_cost <= cost * (1 + 1e-9) + 1e-12:
            settled = np.abs(relative(poses, tried)).max() < 1e-6
            poses, cost, damping = tried, tried_cost, damping / 10
            if settled:
                break
        else:
            damping = max(10 * damping, 1e-6)
            if damping > 1e6:
                break
    return poses


def _step(
    poses: Array, groups: list[_Alike], links: Links, pattern: Pattern, corner: float, damping: float
) -> Array | None:
    """The poses after one step; None where the equations have no solution."""
    weights = robust_weights(squared_distances(poses, links), links.robust, corner)
    equations = normal_equations(poses, links, weights, pattern, pattern.slots(links.ends))
    for group in groups:
        group.add_to(equations, pattern, poses)
    equations.diagonal[:, range(3), range(3)] *= 1 + damping
    if not factorise(pattern, equations.diagonal, equations.below):
        return None
    moved = poses.copy()
    moved[pattern.free] -= solve_factors(pattern, equations.diagonal, equations.below, equations.gradient)
    moved[:, 2] = wrap_angle(moved[:, 2])
    return moved


def _cost(poses: Array, groups: list[_Alike], links: Links, corner: float) -> float:
    squares = squared_distances(poses, links)
    robust = np.where(links.robust, corner * squares / (corner + squares), squares).sum()
    return float(robust + sum(np.square(group.errors(poses)).sum() for group in groups))


def lay_out(pieces: list[Condensed], links: Links, variables: int) -> tuple[Array, Ints, list[Array]]:
    """A first guess by a spanning tree over pieces and links.

    Returns: poses (V, 3), the connected part of each (V,), and each piece's frame (3,).

    Every part begins at the frame of its first piece.
    """
    poses, part = np.zeros((variables, 3)), np.full(variables, -1)
    frames: list[Array | None] = [None] * len(pieces)
    members: list[list[int]] = [[] for _ in range(variables)]
    for p, piece in enumerate(pieces):
        for v in piece.variables:
            members[v].append(p)
    joined: list[list[tuple[float, int, Array]]] = [[] for _ in range(variables)]
    doubts = np.trace(np.linalg.inv(links.informations), axis1=1, axis2=2)
    for (a, b), motion, doubt in zip(links.ends, links.motions, doubts.tolist(), strict=True):
        joined[a].append((doubt, int(b), motion))
        joined[b].append((doubt, int(a), inverse(motion)))
    parts, found = 0, count()
    for root in range(len(pieces)):
        if frames[root] is not None:
            continue
        frames[root], waiting = np.zeros(3), [root]
        bridges: list[tuple[float, int, int, Array]] = []  # a heap: the surest first, then the first that was found
        while waiting or bridges:
            if not waiting:  # all that shares passes is placed; now what only a link joins
                _, _, v, pose = heappop(bridges)
                if part[v] >= 0:
                    continue
                poses[v], part[v] = pose, parts
                waiting += _join_pieces(v, poses[v], pieces, members[v], frames)
                continue
            p = waiting.pop(0)
            frame = frames[p]
            assert frame is not None
            for v, at in zip(pieces[p].variables.tolist(), pieces[p].local, strict=True):
                if part[v] >= 0:
                    continue
                poses[v], part[v] = compose(frame, at), parts
                for doubt, to, motion in joined[v]:
                    if part[to] < 0:
                        heappush(bridges, (doubt, next(found), to, compose(poses[v], motion)))
                waiting += _join_pieces(v, poses[v], pieces, members[v], frames)
        parts += 1
    return poses, part, [frame for frame in frames if frame is not None]


def _join_pieces(
    variable: int, pose: Array, pieces: list[Condensed], members: list[int], frames: list[Array | None]
) -> list[int]:
    """Give the pieces that hold a placed variable their frames; those that had none before."""
    new = [q for q in members if frames[q] is None]
    for q in new:
        at = pieces[q].local[np.flatnonzero(pieces[q].variables == variable)[0]]
        frames[q] = compose(pose, inverse(at))
    return new
