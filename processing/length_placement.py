"""Assembly as the paper has it (section 2.4): edges keep their lengths, turns between them are fitted best.

In: solved pieces. Out: a `Placement`. Every edge is put into its own frame, with the first pose of its first path at
the origin and the last on the x-axis; each drive from one edge into the next measures how one frame is turned against
the other. What error the edges have gathered shows as kinks at the nodes: pieces are not bent to fit.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from processing.assembly import Assembly, assemble_paper, turn_from_headings
from processing.boundary import Boundary, find_boundary
from processing.edge_placement import Placed, Placement, lay_side_by_side, remark_parts
from processing.geometry import compose, inverse, relative
from processing.graph import Graph
from processing.pieces import SolvedPiece
from processing.pose_graph import Links
from processing.registration import Passing, register_passes
from processing.scan_matching import Matcher
from processing.workers import Workers

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Key = tuple[int, int]  # of a pass: run, scan

SHORT_M = 2.0  # two tags this close are one node of the assembly: the centres of their clouds jitter by as much


def place_by_lengths(solved: list[SolvedPiece], graph: Graph, _match: Matcher, _work: Workers) -> Placement:
    """The paper's assembly of all edges; spurs are hung on what they share a pass with, or else a tag.

    So are edges too short to have a direction: two tags on one bolt are one node, and a drive by them one turn.
    """
    joins = [p for p, piece in enumerate(solved) if piece.input.piece.j is not None]
    local = [relative(_own_frame(piece), piece.map.poses) for piece in solved]
    edges = [p for p in joins if _length(solved[p], local[p]) > SHORT_M]
    short = [p for p in joins if p not in edges]
    united = _unite_nodes([_nodes_of(solved[p]) for p in short], len(graph.nodes))
    links = _links_of_passes(solved)
    assembly = _assemble(solved, edges, short, united, local, links)
    frames, parts = [np.zeros(3) for _ in solved], [-1 for _ in solved]
    passes: dict[Key, tuple[Array, int]] = {}  # pose in the atlas, part
    for p in edges:
        i, j = (assembly.positions[united[node]] for node in _nodes_of(solved[p]))
        frames[p] = np.array([*i, np.arctan2(*(j - i)[::-1])])
        parts[p] = int(assembly.parts[united[_nodes_of(solved[p])[0]]])
        for key, _, index in _passes_of(solved[p]):
            passes.setdefault(key, (compose(frames[p], local[p][index]), parts[p]))
    waiting = [p for p in range(len(solved)) if p not in edges]
    while waiting:  # a spur may hang on another spur; one that hangs on nothing begins a part
        holds = {p: hold for p in waiting if (hold := _find_hold(solved[p], passes, links)) is not None}
        p = next(iter(holds), waiting[0])
        waiting.remove(p)
        parts[p] = len(graph.nodes) + p
        if p in holds:
            pose, parts[p], index = holds[p]
            frames[p] = compose(pose, inverse(local[p][index]))
        for key, _, index in _passes_of(solved[p]):
            passes.setdefault(key, (compose(frames[p], local[p][index]), parts[p]))
    parts = np.unique(parts, return_inverse=True)[1].tolist()
    shifts = lay_side_by_side([compose(frame, poses) for frame, poses in zip(frames, local, strict=True)], parts)
    placed = [
        Placed(piece, frames[p] + np.array([shifts[parts[p]], 0.0, 0.0]), local[p], parts[p])
        for p, piece in enumerate(solved)
    ]
    nodes, node_parts = np.zeros((len(graph.nodes), 3)), np.full(len(graph.nodes), -1)
    for of in sorted(placed, key=lambda piece: piece.solved.input.piece.j is None):  # edges have the say on their nodes
        for _, node, index in _passes_of(of.solved):
            if node_parts[node] < 0:
                nodes[node], node_parts[node] = of.poses[index], of.part
    return Placement(placed, nodes, node_parts, _remarks(solved, edges, assembly) + remark_parts(parts))


def link_nodes(solved: list[SolvedPiece], boundary: Boundary) -> Links:
    """Links between passes of one tag in parts of the map that no run joins: all else is joined without guessing."""
    seen_in: dict[int, tuple[SolvedPiece, int]] = {}
    for piece, variables, indices in zip(solved, boundary.variables, boundary.indices, strict=True):
        seen_in |= {v: (piece, i) for v, i in zip(variables, indices, strict=True)}

    def passing(variable: int) -> Passing:
        piece, index = seen_in[variable]
        p = piece.path_of(index)
        first, last = piece.ends(p)
        reach_m = piece.input.piece.spans[p].reaches_m[index == last]
        mount = piece.input.sights[p].sweeps.mount
        return Passing(piece.map.poses[first : last + 1], piece.input.paths[p].scans, mount, index - first, reach_m)

    edges = [(variables[0], v) for variables in boundary.variables for v in variables]
    shape = (boundary.count, boundary.count)
    part = connected_components(coo_array((np.ones(len(edges)), tuple(np.array(edges).T)), shape=shape))[1]
    ends, motions, informations = [], [], []
    for passes in boundary.passes_of_nodes().values():
        linked: list[int] = []
        for v in passes:
            for u in [u for u in linked if part[u] != part[v]][:3]:
                found = register_passes(passing(u), passing(v))
                if found is not None:
                    ends.append((u, v))
                    motions.append(found.motion)
                    informations.append(np.linalg.inv(found.covariance))
            linked.append(v)
    return Links.of(np.array(ends), np.array(motions), np.array(informations), robust=True)


def _links_of_passes(solved: list[SolvedPiece]) -> list[tuple[Key, Key, Array]]:
    """Passes that no drive joins, and the motion (3,) from the first to the second that their scans tell."""
    boundary = find_boundary(solved)
    key_of = {variable: key for key, variable in boundary.passes.items()}
    links = link_nodes(solved, boundary)
    return [(key_of[u], key_of[v], motion) for (u, v), motion in zip(links.ends.tolist(), links.motions, strict=True)]


def _find_hold(
    piece: SolvedPiece, passes: dict[Key, tuple[Array, int]], links: list[tuple[Key, Key, Array]]
) -> tuple[Array, int, int] | None:
    """What is known in the atlas of a pass of this piece: its pose, the part, and which pose of the piece it is."""
    own = {key: index for key, _, index in _passes_of(piece)}
    for key, index in own.items():
        if key in passes:
            return (*passes[key], index)
    for u, v, motion in links:
        for known, unknown, way in ((u, v, motion), (v, u, inverse(motion))):
            if known in passes and unknown in own:
                pose, part = passes[known]
                return compose(pose, way), part, own[unknown]
    return None


def _nodes_of(edge: SolvedPiece) -> tuple[int, int]:
    i, j = edge.input.piece.i, edge.input.piece.j
    assert i is not None
    assert j is not None  # it is an edge
    return i, j


def _length(edge: SolvedPiece, local: Array) -> float:
    """From pass to pass of the first path, in the edge's own frame."""
    a, b = edge.ends(0)
    return float(np.hypot(*(local[b, :2] - local[a, :2])))


def _unite_nodes(pairs: list[tuple[int, int]], count: int) -> Ints:
    """For each node (count,) the number of the node of the assembly that it belongs to."""
    i, j = np.array(pairs, np.int64).reshape(-1, 2).T
    return np.asarray(connected_components(coo_array((np.ones(len(i)), (i, j)), shape=(count, count)))[1], np.int64)


def _own_frame(piece: SolvedPiece) -> Array:
    """The frame of a piece, in that of its poses; of an edge, from the first path's pass of i to that of j (figure
    6c).
    """
    if piece.input.piece.j is None:
        return piece.map.poses[0]
    a, b = piece.ends(0)
    if piece.input.piece.spans[0].start != piece.input.piece.i:
        a, b = b, a
    origin, end = piece.map.poses[a], piece.map.poses[b]
    return np.array([origin[0], origin[1], np.arctan2(end[1] - origin[1], end[0] - origin[0])])


def _passes_of(piece: SolvedPiece) -> list[tuple[Key, int, int]]:
    """Key, node and pose of every pass that ends a path of the piece."""
    out = []
    for k, span in enumerate(piece.input.piece.spans):
        for index, scan, node in zip(piece.ends(k), (span.first, span.last), (span.start, span.end), strict=True):
            if node is not None:
                out.append(((span.run, scan), node, index))
    return out


def _assemble(
    solved: list[SolvedPiece],
    edges: list[int],
    short: list[int],
    united: Ints,  # (nodes,) node of the assembly
    local: list[Array],
    links: list[tuple[Key, Key, Array]],
) -> Assembly:
    ends = united[np.array([_nodes_of(solved[p]) for p in edges], np.int64).reshape(-1, 2)]
    lengths = [_length(solved[p], local[p]) for p in edges]
    headings: dict[Key, list[tuple[int, float]]] = {}
    for number, p in enumerate(edges):
        for key, _, index in _passes_of(solved[p]):
            headings.setdefault(key, []).append((number, local[p][index, 2]))
    # A drive from one edge into the next: the pass is one pose, seen from both edges, and δ of eq. 5 is zero.
    joints = [(key, key, 0.0) for key, pair in headings.items() if len(pair) == 2]
    # A drive past tags that are one node: δ is what it turned from the first to the last of them.
    turned = {
        first: (last, float(local[p][b, 2] - local[p][a, 2]))
        for p in short
        for passes in [_passes_of(solved[p])]
        for (first, _, a), (last, _, b) in zip(passes[::2], passes[1::2], strict=True)
    }
    for first in sorted(headings.keys() & turned.keys()):
        last, delta = turned[first]
        while last not in headings and last in turned:
            last, further = turned[last]
            delta += further
        joints.append((first, last, delta))
    # Passes that no drive joins: δ is what their scans say.
    joints += [(u, v, float(motion[2])) for u, v, motion in links]
    turns = [
        (a, b, float(turn_from_headings(alpha, delta, beta)))
        for first, second, delta in joints
        for a, alpha in headings.get(first, [])[:1]
        for b, beta in headings.get(second, [])[-1:]
        if a != b
    ]
    turn_edges = np.array([(a, b) for a, b, _ in turns], np.int64).reshape(-1, 2)
    return assemble_paper(
        int(united.max(initial=-1)) + 1, ends, np.array(lengths), turn_edges, np.array([t for _, _, t in turns])
    )


def _remarks(solved: list[SolvedPiece], edges: list[int], assembly: Assembly) -> list[str]:
    if not assembly.violated:
        return []
    names = ", ".join(solved[edges[e]].input.name for e in assembly.violated)
    return [f"the lengths of edges {names} cannot all hold in the plane; the assembly stretches them"]
