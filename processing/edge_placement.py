"""From solved pieces to one atlas frame: by frames (refined), or by lengths and turns as the paper does.

In: pieces, each in a frame of its own. Out: nodes with their poses, and every piece with its frame in the atlas and
its poses in that frame. The frame of an edge lies at its lower node, its x-axis through the other (paper, figure 6c);
spurs lie at their node; a run without tags at its first pose. Unconnected parts are laid out side by side.
"""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from processing.frame_assembly import Condensed, condense, lay_out, solve_frames
from processing.geometry import align, compose, inverse, relative
from processing.graph import Graph
from processing.pieces import SolvedPiece
from processing.pose_graph import Links, Solution, solve
from processing.registration import register_passes
from processing.scan_match import ScanMatch
from processing.scan_matching import Matcher
from processing.scan_walls import Scan
from processing.strong_links import LOOP_INLIERS, blur, match_vehicles, worth_a_link
from processing.sweeps import StoredScans
from processing.workers import Workers

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

OVERLAP_M = 2.5  # key frames of different pieces this close see the same walls
OVERLAP_SPACING_M = 3.0
OVERLAP_ROUNDS = 2
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


@dataclass(frozen=True, slots=True)
class Boundary:
    """Which poses of the pieces are the same variable of the assembly: a pass ends one piece and begins the next."""

    indices: list[list[int]]  # per piece: poses
    variables: list[list[int]]  # per piece: their variables
    passes: dict[tuple[int, int], int]  # (run, scan) → variable
    nodes: dict[int, int]  # variable → node

    @property
    def count(self) -> int:
        return 1 + max((v for piece in self.variables for v in piece), default=-1)

    def add(self, piece: int, index: int) -> int:
        """A variable for a pose within a piece, new or known."""
        if index in self.indices[piece]:
            return self.variables[piece][self.indices[piece].index(index)]
        variable = self.count
        self.indices[piece].append(index)
        self.variables[piece].append(variable)
        return variable


def find_boundary(solved: list[SolvedPiece]) -> Boundary:
    boundary = Boundary([[] for _ in solved], [[] for _ in solved], {}, {})
    for p, piece in enumerate(solved):
        for k, span in enumerate(piece.input.piece.spans):
            for index, scan, node in zip(piece.ends(k), (span.first, span.last), (span.start, span.end), strict=True):
                if node is None:
                    continue
                known = boundary.passes.get((span.run, scan))
                variable = boundary.count if known is None else known
                boundary.passes[span.run, scan] = variable
                boundary.nodes[variable] = node
                boundary.indices[p].append(index)
                boundary.variables[p].append(variable)
        if not boundary.indices[p]:
            boundary.add(p, 0)
    return boundary


def condense_all(solved: list[SolvedPiece], boundary: Boundary, work: Workers) -> list[Condensed]:
    maps = [piece.map for piece in solved]
    return work.starmap(
        "assembly",
        condense,
        [
            (of.poses, of.links, of.solution.weights, np.array(indices, np.int64), np.array(variables, np.int64))
            for of, indices, variables in zip(maps, boundary.indices, boundary.variables, strict=True)
        ],
    )


def link_nodes(solved: list[SolvedPiece], boundary: Boundary) -> Links:
    """Links between passes of one tag in parts of the map that no run joins: all else is joined without guessing."""
    seen_in: dict[int, tuple[SolvedPiece, int]] = {}
    for piece, variables, indices in zip(solved, boundary.variables, boundary.indices, strict=True):
        seen_in |= {v: (piece, i) for v, i in zip(variables, indices, strict=True)}

    def scan(variable: int) -> Scan:
        piece, index = seen_in[variable]
        return piece.scan(index)[0]

    edges = [(variables[0], v) for variables in boundary.variables for v in variables]
    shape = (boundary.count, boundary.count)
    part = connected_components(coo_array((np.ones(len(edges)), tuple(np.array(edges).T)), shape=shape))[1]
    ends, motions, informations = [], [], []
    for node in sorted(set(boundary.nodes.values())):
        linked: list[int] = []
        for v in sorted(v for v, of in boundary.nodes.items() if of == node):
            for u in [u for u in linked if part[u] != part[v]][:3]:
                found = register_passes(scan(u), scan(v), solved[0].input.mount)
                if found is not None:
                    ends.append((u, v))
                    motions.append(found.motion)
                    informations.append(np.linalg.inv(found.covariance))
            linked.append(v)
    return Links.of(np.array(ends), np.array(motions), np.array(informations), robust=True)


@dataclass(frozen=True, slots=True)
class Overlap:
    """Key frames of two pieces that lie over each other, k pairs of them."""

    numbers: tuple[int, int]  # of the pieces
    mount: Array  # (3,) scanner in the vehicle
    indices: list[tuple[int, int]]  # k
    scans: list[tuple[StoredScans, StoredScans]]  # k, one scan each
    guesses: list[Array]  # k of (3,): the second seen from the first

    def match(self, match: Matcher) -> list[ScanMatch]:
        """k matches, of the vehicle."""
        return [
            match_vehicles(one[0], other[0], guess, self.mount, match)
            for (one, other), guess in zip(self.scans, self.guesses, strict=True)
        ]


def find_overlaps(solved: list[SolvedPiece], frames: list[Array], parts: list[int]) -> list[Overlap]:
    poses = [compose(frame, piece.map.poses) for frame, piece in zip(frames, solved, strict=True)]
    trees = [cKDTree(of[:, :2]) for of in poses]
    low = np.array([of[:, :2].min(axis=0) for of in poses]) - OVERLAP_M
    high = np.array([of[:, :2].max(axis=0) for of in poses])
    found = []
    for q in range(len(solved)):
        for p in np.flatnonzero(np.all(low[:q] < high[q], axis=1) & np.all(low[q] < high[:q], axis=1)):
            if parts[p] != parts[q]:
                continue
            distance, near = trees[p].query(poses[q][:, :2], distance_upper_bound=OVERLAP_M)
            last, overlap = np.full(2, np.inf), Overlap((int(p), q), solved[q].input.mount, [], [], [])
            for k in np.flatnonzero(np.isfinite(distance)):
                if np.hypot(*(poses[q][k, :2] - last)) < OVERLAP_SPACING_M:
                    continue
                i, last = int(near[k]), poses[q][k, :2]
                overlap.indices.append((i, int(k)))
                overlap.scans.append((solved[p].scan(i), solved[q].scan(int(k))))
                overlap.guesses.append(relative(poses[p][i], poses[q][k]))
            found += [overlap] * bool(overlap.indices)
    return found


def link_overlaps(overlaps: list[Overlap], boundary: Boundary, match: Matcher, work: Workers) -> Links:
    """Links between the key frames of overlaps, which join the boundary."""
    ends, motions, informations = [], [], []
    matches = work.map("overlaps", partial(Overlap.match, match=match), overlaps)
    for overlap, found in zip(overlaps, matches, strict=True):
        p, q = overlap.numbers
        for (i, k), seen in zip(overlap.indices, found, strict=True):
            if worth_a_link(seen, LOOP_INLIERS):
                a, b = boundary.add(p, i), boundary.add(q, k)
                if a == b:  # the pass that both begin with: nothing between
                    continue
                ends.append((a, b))
                motions.append(seen.motion)
                informations.append(np.linalg.inv(blur(seen.covariance)))
    return Links.of(np.array(ends), np.array(motions), np.array(informations), robust=True)


def bend(
    solved: list[SolvedPiece], boundary: Boundary, poses: Array, frames: list[Array], work: Workers
) -> list[SolvedPiece]:
    """Solve the pieces again with their boundary where the assembly has put it; they come out in the atlas frame."""
    tasks = []
    for piece, indices, variables, frame in zip(solved, boundary.indices, boundary.variables, frames, strict=True):
        guess, fixed = compose(frame, piece.map.poses), np.zeros(len(piece.map.poses), bool)
        guess[indices], fixed[indices] = poses[variables], True
        tasks.append((guess, piece.map.links, fixed))
    solutions: list[Solution] = work.starmap("assembly", solve, tasks)
    return [
        replace(piece, map=replace(piece.map, poses=found.poses, solution=found))
        for piece, found in zip(solved, solutions, strict=True)
    ]


def place_by_frames(solved: list[SolvedPiece], graph: Graph, match: Matcher, work: Workers) -> Placement:
    """The refined assembly: least squares of all that the pieces know of each other, then the pieces bent to fit."""
    boundary = find_boundary(solved)
    condensed = condense_all(solved, boundary, work)
    links = link_nodes(solved, boundary)
    poses, part, frames = lay_out(condensed, links, boundary.count)
    poses, _ = solve_frames(poses, condensed, links, _first_of_each(part))
    frames = [fit_frame(piece, poses) for piece in condensed]
    parts = [int(part[piece.variables[0]]) for piece in condensed]
    for _ in range(OVERLAP_ROUNDS):
        grown = find_boundary(solved)
        more = links + link_overlaps(find_overlaps(solved, frames, parts), grown, match, work)
        condensed = condense_all(solved, grown, work)
        poses, part, _ = lay_out(condensed, more, grown.count)
        poses, weights = solve_frames(poses, condensed, more, _first_of_each(part))
        frames, boundary = [fit_frame(piece, poses) for piece in condensed], grown
        parts = [int(part[piece.variables[0]]) for piece in condensed]
    bent = bend(solved, boundary, poses, frames, work)
    doubted = int((weights < 0.1).sum())
    notes = [f"{doubted} of {len(more)} links between pieces contradict the rest and were left out"] if doubted else []
    return _settle(bent, parts, boundary, poses, graph, notes)


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
    bent: list[SolvedPiece], parts: list[int], boundary: Boundary, poses: Array, graph: Graph, notes: list[str]
) -> Placement:
    """Nodes where their passes are on average; parts side by side; the pieces in their own frames."""
    parts_of_nodes = np.full(len(graph.nodes), -1)
    nodes = np.zeros((len(graph.nodes), 3))
    part_of = {v: parts[p] for p, variables in enumerate(boundary.variables) for v in variables}
    for node in range(len(graph.nodes)):
        passes = [v for v, of in boundary.nodes.items() if of == node]
        homes = np.array([part_of[v] for v in passes])
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
