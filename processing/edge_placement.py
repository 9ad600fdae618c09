"""From solved pieces to one atlas frame: by frames (refined), or by lengths and turns as the paper does.

In: pieces, each in a frame of its own. Out: nodes with their poses, and every piece with its frame in the atlas and
its poses in that frame. The frame of an edge lies at its lower node, its x-axis through the other (paper, figure 6c);
spurs lie at their node; a run without tags at its first pose. Unconnected parts are laid out side by side.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from processing.boundary import Boundary, find_boundary
from processing.condensed import Condensed, condense
from processing.frame_assembly import lay_out, solve_frames
from processing.geometry import align, compose, inverse, relative
from processing.graph import Graph
from processing.linked_paths import TAG_INFORMATION, TagJoin, join_groups, merge_groups, split_groups
from processing.overlaps import Known, find_overlaps, link_overlaps
from processing.part_joining import Join, join_parts, tag_links
from processing.pieces import SolvedPiece
from processing.placed_drives import find_tag_passes, place_drives
from processing.pose_graph import Links, Solution, solve
from processing.scan_matching import Matcher
from processing.workers import Workers

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
_Thin = tuple[Join, Ints]  # a join by one tag, and the part (pieces,) of every piece before it

OVERLAP_ROUNDS = 2
SURE_LINKS = 5  # between two parts: so many scan matches hold them together, whatever a tag says
PART_GAP_M = 20.0  # the range of the scanner, so that grids do not touch either


@dataclass(frozen=True, slots=True)
class Placed:
    """A piece in the atlas."""

    solved: SolvedPiece
    frame: Array  # (3,) of the piece, in the atlas
    edge_poses: Array  # (N, 3) of its key frames, in that frame
    part: int

    @property
    def poses(self) -> Array:
        """(N, 3) of its key frames, in the atlas."""
        return compose(self.frame, self.edge_poses)


@dataclass(frozen=True, slots=True)
class Placement:
    pieces: list[Placed]
    nodes: Array  # (nodes, 3)
    node_parts: Ints  # (nodes,)
    remarks: list[str]


def condense_all(solved: list[SolvedPiece], boundary: Boundary) -> list[Condensed]:
    """Here alone: to send the links to other processes takes longer."""
    return [
        condense(of.map.poses, of.map.links, of.map.solution.weights, np.array(indices), np.array(variables))
        for of, indices, variables in zip(solved, boundary.indices, boundary.variables, strict=True)
    ]


def link_tags(joins: list[TagJoin], boundary: Boundary) -> Links:
    """Links of what tags alone say of groups of paths; their poses are passes, so they are in the boundary."""
    ends = [tuple(boundary.add(g, index) for g, index in zip(of.groups, of.indices, strict=True)) for of in joins]
    informations = np.tile(TAG_INFORMATION, (len(joins), 1, 1))
    return Links.of(np.array(ends), np.array([of.motion for of in joins]), informations, robust=False)


def bend(
    solved: list[SolvedPiece], boundary: Boundary, poses: Array, frames: list[Array], work: Workers
) -> list[SolvedPiece]:
    """Solve the pieces again with their boundary where the assembly has put it; they come out in the atlas frame."""
    tasks = []
    for piece, indices, variables, frame in zip(solved, boundary.indices, boundary.variables, frames, strict=True):
        guess, fixed = compose(frame, piece.map.poses), np.zeros(len(piece.map.poses), bool)
        guess[indices], fixed[indices] = poses[variables], True
        tasks.append((guess, piece.map.links, fixed))
    solutions: list[Solution] = work.starmap("assembly", solve, tasks, at_once=10)
    return [
        replace(piece, map=replace(piece.map, poses=found.poses, solution=found))
        for piece, found in zip(solved, solutions, strict=True)
    ]


def place_by_frames(solved: list[SolvedPiece], graph: Graph, match: Matcher, work: Workers, known: Known) -> Placement:
    """The refined assembly: least squares of all that the pieces know of each other, then the pieces bent to fit.

    Tags come before looks: what overlaps is searched for where the tags have put the pieces.

    `known`: overlaps matched before, for the assembly that comes after this one.
    """
    groups = split_groups(solved)
    pieces = [group.solved for group in groups]
    boundary = find_boundary(pieces)
    condensed = condense_all(pieces, boundary)
    links = link_tags(join_groups(groups), boundary)
    poses, part, frames = lay_out(condensed, links, boundary.count)
    passes = find_tag_passes(pieces, boundary, graph)
    links = links + tag_links(passes, part, [piece.variables for piece in condensed])
    poses, _ = solve_frames(poses, condensed, links, _first_of_each(part))
    frames = [fit_frame(piece, poses) for piece in condensed]
    joins = join_parts(place_drives(pieces, frames, [int(part[of.variables[0]]) for of in condensed]), passes)
    parts, frames, thin = _join(joins, [int(part[piece.variables[0]]) for piece in condensed], frames)
    links = sum((join.links for join in joins), links)
    if joins:
        poses = spread_out(condensed, frames, boundary.count)
        poses, _ = solve_frames(poses, condensed, links, _first_of_each(_parts_of(condensed, parts, boundary.count)))
        frames = [fit_frame(piece, poses) for piece in condensed]
    for _ in range(OVERLAP_ROUNDS):
        grown = find_boundary(pieces)
        overlaps = find_overlaps(pieces, frames, parts, known)
        more = links + link_overlaps(overlaps, grown, match, work, known)
        condensed = condense_all(pieces, grown)
        poses = spread_out(condensed, frames, grown.count)
        poses, weights = solve_frames(poses, condensed, more, _first_of_each(_parts_of(condensed, parts, grown.count)))
        frames, boundary = [fit_frame(piece, poses) for piece in condensed], grown
    bent = bend(pieces, boundary, poses, frames, work)
    doubted = int((weights < 0.1).sum())
    of_variable = {int(v): p for p, piece in enumerate(condensed) for v in piece.variables}
    believed = more.ends[len(links) :][weights[len(links) :] > 0.5]
    linked = np.array([(of_variable[a], of_variable[b]) for a, b in believed.tolist()], np.int64).reshape(-1, 2)
    notes = [_tell_join(join, graph) for join, before in thin if _links_between(join, before[linked]) < SURE_LINKS]
    notes += [f"{doubted} of {len(more)} links between pieces contradict the rest and were left out"] * (doubted > 0)
    homes = {v: part for variables, part in zip(boundary.variables, parts, strict=True) for v in variables}
    of_pieces = dict(reversed([(group.piece, part) for group, part in zip(groups, parts, strict=True)]))
    merged = merge_groups(solved, groups, bent)
    return _settle(merged, [of_pieces[p] for p in range(len(solved))], boundary, homes, poses, graph, notes)


def _join(joins: list[Join], parts: list[int], frames: list[Array]) -> tuple[list[int], list[Array], list[_Thin]]:
    """Part and frame of every piece after the joins, parts numbered from 0; and what hangs together by one tag."""
    of, thin = np.array(parts), list[_Thin]()
    for join in joins:
        if len(join.nodes) == 1:
            thin.append((join, of))
        moved = of == join.parts[1]
        frames = [compose(join.move, frame) if moves else frame for frame, moves in zip(frames, moved, strict=True)]
        of = np.where(moved, join.parts[0], of)
    return np.unique(of, return_inverse=True)[1].tolist(), frames, thin


def _links_between(join: Join, parts: Ints) -> int:
    """How many of the links, between pieces of these parts (m, 2), join the two parts as well."""
    return int(np.all(np.sort(parts, axis=1) == np.sort(join.parts), axis=1).sum())


def _tell_join(join: Join, graph: Graph) -> str:
    return f"parts of the map are joined by tag {graph.nodes[join.nodes[0]].epc} alone"


def spread_out(pieces: list[Condensed], frames: list[Array], count: int) -> Array:
    """Poses (V, 3) of all variables, where the frames of the pieces put them."""
    poses = np.zeros((count, 3))
    for piece, frame in zip(pieces, frames, strict=True):
        poses[piece.variables] = compose(frame, piece.local)
    return poses


def _parts_of(pieces: list[Condensed], parts: list[int], count: int) -> Ints:
    """The part (V,) of every variable."""
    part = np.zeros(count, np.int64)
    for piece, of in zip(pieces, parts, strict=True):
        part[piece.variables] = of
    return part


def fit_frame(piece: Condensed, poses: Array) -> Array:
    """The pose (3,) of a piece's frame that brings its boundary closest to where the assembly has it."""
    there = poses[piece.variables]
    if len(there) == 1 or np.ptp(there[:, :2], axis=0).max() < 1.0:
        return compose(there[0], inverse(piece.local[0]))
    return align(piece.local[:, :2], there[:, :2])


def _first_of_each(part: Ints) -> NDArray[np.bool_]:
    fixed = np.zeros(len(part), bool)
    fixed[np.unique(part, return_index=True)[1]] = True
    return fixed


def _settle(
    bent: list[SolvedPiece],
    parts: list[int],
    boundary: Boundary,
    homes_of: dict[int, int],
    poses: Array,
    graph: Graph,
    notes: list[str],
) -> Placement:
    """Nodes where their passes are on average; parts side by side; the pieces in their own frames.

    Args:
        bent: In the frame of their part.
        parts: Of the pieces.
        boundary: Its passes make the nodes.
        homes_of: The part of each variable of the boundary.
        poses: (V, 3) of those variables.
        graph: Its nodes are placed.
        notes: What is to be told so far.
    """
    parts_of_nodes = np.full(len(graph.nodes), -1)
    nodes = np.zeros((len(graph.nodes), 3))
    for node, passes in boundary.passes_of_nodes().items():
        homes = np.array([homes_of[v] for v in passes])
        at = poses[np.array(passes)[homes == homes[0]]]
        nodes[node] = [*at[:, :2].mean(axis=0), at[0, 2]]
        parts_of_nodes[node] = homes[0]
        if len(set(homes.tolist())) > 1:
            notes.append(f"passes of {graph.nodes[node].epc} could not be joined: the map has a part for each")
    shifts = lay_side_by_side([piece.map.poses for piece in bent], parts)
    nodes[:, 0] += shifts[parts_of_nodes]
    placed = []
    for piece, part in zip(bent, parts, strict=True):
        atlas_poses = piece.map.poses + np.array([shifts[part], 0.0, 0.0])
        frame = edge_frame(piece, nodes, atlas_poses)
        placed.append(Placed(piece, frame, relative(frame, atlas_poses), part))
    return Placement(placed, nodes, parts_of_nodes, notes + remark_parts(parts))


def remark_parts(parts: list[int]) -> list[str]:
    """What to tell of the part of every piece."""
    if max(parts, default=0) == 0:
        return []
    return [f"the map falls into {max(parts) + 1} unconnected parts; they are laid out side by side"]


def edge_frame(piece: SolvedPiece, nodes: Array, poses: Array) -> Array:
    i, j = piece.input.piece.i, piece.input.piece.j
    if i is None:
        return poses[0]
    if j is None:
        return nodes[i]
    return np.array([*nodes[i, :2], np.arctan2(*(nodes[j, :2] - nodes[i, :2])[::-1])])


def lay_side_by_side(poses: list[Array], parts: list[int]) -> Array:
    """How far to move each part along x so that none covers another; `poses` (N, 3) and part of every piece."""
    shifts, edge = np.zeros(max(parts, default=0) + 1), None
    for part in range(len(shifts)):
        x = np.concatenate([of_piece[:, 0] for of_piece, of in zip(poses, parts, strict=True) if of == part])
        if edge is not None:
            shifts[part] = edge + PART_GAP_M - x.min()
        edge = x.max() + shifts[part] + PART_GAP_M
    return shifts
