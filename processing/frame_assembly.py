"""Assembly beyond the paper: pieces as relative poses of their boundary, with full covariance, in one small pose graph.

In: each piece, solved by itself in its own frame. Out: the poses of its boundary, the passes of tags above all, in
one frame.

    piece A  ●━━━━━━━━━●              ● boundary: a pass belongs to the piece before it and to the piece after it, and
                       ●━━━━━━● B     joins them rigidly; the rest of a piece is eliminated exactly, so what is left
           pass shared by A and B     is small, and to solve it is to solve the whole network

Where pieces overlap without sharing a pass (two passes of one tag in different pieces, two edges before the same
junction), links between their key frames join them; those key frames then belong to the boundary too.
"""

from heapq import heappop, heappush
from itertools import count

import numpy as np
from numpy.typing import NDArray

from processing.block_cholesky import Pattern, factorise, find_pattern, solve_factors
from processing.condensed import Alike, Condensed, group_alike
from processing.geometry import compose, inverse, relative, wrap_angle
from processing.pose_graph import CORNER, Links, normal_equations, robust_weights, squared_distances

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

GRADUAL = (1e4, 1e3, 1e2, CORNER)


def solve_frames(
    first_guess: Array, pieces: list[Condensed], links: Links, fixed: NDArray[np.bool_], max_iterations: int = 50
) -> tuple[Array, Array]:
    """Poses (V, 3) of all variables, and the weight (m,) of each link between pieces. Damped Gauss–Newton.

    With falling corners (graduated non-convexity): a loop that comes back a metre off is closed by its links, which
    agree, before any of them is doubted. `fixed` (V,): one variable of each connected part, at least.
    """
    poses, groups = first_guess, group_alike(pieces)
    ends = np.concatenate([links.ends, *(group.pairs.reshape(-1, 2) for group in groups)])
    pattern = find_pattern(len(poses), ends, fixed)
    for corner in GRADUAL if np.any(links.robust) else (CORNER,):
        poses = _minimise(poses, groups, links, pattern, corner, max_iterations)
    return poses, robust_weights(squared_distances(poses, links), links.robust, CORNER)


def _minimise(
    first_guess: Array, groups: list[Alike], links: Links, pattern: Pattern, corner: float, max_iterations: int
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
    poses: Array, groups: list[Alike], links: Links, pattern: Pattern, corner: float, damping: float
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


def _cost(poses: Array, groups: list[Alike], links: Links, corner: float) -> float:
    squares = squared_distances(poses, links)
    robust = np.where(links.robust, corner * squares / (corner + squares), squares).sum()
    return float(robust + sum(group.cost(poses) for group in groups))


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
