"""Paths of one piece that no scan match joins, taken apart for the assembly and put together after it.

In: a solved piece. Out: its groups of paths that links join, each a solved piece of its own; and what the tags say of
where the groups lie. Two drives by one junction, out of different drifts, see different walls: between them nothing is
known but that both passed the same tag. A piece is condensed about its own poses, to first order, and a turn of a
radian between two of its paths is no small error: it would bend both.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from processing.edge_map import TAG_M, TAG_RAD, PieceMap
from processing.geometry import relative
from processing.pieces import SolvedPiece
from processing.pose_graph import CORNER, robust_weights, squared_distances

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Group:
    """Paths of a piece that hang together, as a piece; its first path is the first of them."""

    solved: SolvedPiece
    piece: int  # number of the piece
    rows: Ints  # (n,) its poses among the N of the piece


def split_groups(solved: Sequence[SolvedPiece]) -> list[Group]:
    """The groups of all pieces; of most pieces one, with all of it."""
    return [group for number, piece in enumerate(solved) for group in _groups_of(number, piece)]


def _groups_of(number: int, piece: SolvedPiece) -> list[Group]:
    found, links = piece.map, piece.map.links
    path = np.searchsorted(found.firsts, links.ends, side="right") - 1
    count = len(found.firsts) - 1
    joined = path[links.robust & (path[:, 0] != path[:, 1])]
    groups_count, label = connected_components(coo_array((np.ones(len(joined)), tuple(joined.T)), shape=(count, count)))
    if groups_count == 1:
        return [Group(piece, number, np.arange(len(found.poses)))]
    groups = []
    for group in range(groups_count):
        paths = np.flatnonzero(label == group)
        rows = np.concatenate([np.arange(found.firsts[p], found.firsts[p + 1]) for p in paths])
        place = np.full(len(found.poses), -1)
        place[rows] = np.arange(len(rows))
        kept = np.flatnonzero(np.all(place[links.ends] >= 0, axis=1))
        given = replace(
            piece.input,
            piece=replace(piece.input.piece, spans=tuple(piece.input.piece.spans[p] for p in paths)),
            paths=tuple(piece.input.paths[p] for p in paths),
            sights=tuple(piece.input.sights[p] for p in paths),
        )
        own = replace(links[kept], ends=place[links.ends[kept]])
        solution = replace(
            found.solution,
            poses=found.poses[rows],
            squared_distances=found.solution.squared_distances[kept],
            weights=found.solution.weights[kept],
        )
        firsts = np.append(0, np.cumsum(np.diff(found.firsts)[paths]))
        groups.append(Group(SolvedPiece(given, PieceMap(found.poses[rows], firsts, own, solution)), number, rows))
    return groups


@dataclass(frozen=True, slots=True)
class TagJoin:
    """One tag, passed in two groups of a piece: the second pose seen from the first, as far as the tag alone tells."""

    groups: tuple[int, int]
    indices: tuple[int, int]
    motion: Array  # (3,)


TAG_INFORMATION = np.diag([TAG_M**-2, TAG_M**-2, TAG_RAD**-2])


def join_groups(groups: Sequence[Group]) -> list[TagJoin]:
    """Each further group of a piece to its first, at both tags of the piece."""
    joins, first_of = [], {group.piece: g for g, group in reversed(list(enumerate(groups)))}
    for g, group in enumerate(groups):
        f = first_of[group.piece]
        if g == f:
            continue
        ours, theirs = _ends_by_node(group.solved), _ends_by_node(groups[f].solved)
        for node in sorted(ours.keys() & theirs.keys()):
            pair = theirs[node], ours[node]
            motion = relative(groups[f].solved.map.poses[pair[0]], group.solved.map.poses[pair[1]])
            joins.append(TagJoin((f, g), pair, motion))
    return joins


def _ends_by_node(piece: SolvedPiece) -> dict[int, int]:
    """The first pose at each tag of the piece."""
    found: dict[int, int] = {}
    for p, span in enumerate(piece.input.piece.spans):
        for node, index in zip((span.start, span.end), piece.ends(p), strict=True):
            if node is not None:
                found.setdefault(node, index)
    return found


def merge_groups(
    solved: Sequence[SolvedPiece], groups: Sequence[Group], placed: Sequence[SolvedPiece]
) -> list[SolvedPiece]:
    """The pieces with their poses as those of their groups have come out, in `placed`, in one frame."""
    merged = []
    all_poses = [piece.map.poses.copy() for piece in solved]
    for group, at in zip(groups, placed, strict=True):
        all_poses[group.piece][group.rows] = at.map.poses
    for piece, poses in zip(solved, all_poses, strict=True):
        squares = squared_distances(poses, piece.map.links)
        weights = robust_weights(squares, piece.map.links.robust, CORNER)
        solution = replace(piece.map.solution, poses=poses, squared_distances=squares, weights=weights)
        merged.append(replace(piece, map=replace(piece.map, poses=poses, solution=solution)))
    return merged
