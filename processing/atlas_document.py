"""From the stages' records to the atlas: what stands in atlas.json, in the edges' files and in the trajectories."""

from collections.abc import Mapping
from dataclasses import asdict
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from processing.atlas import SCHEMA, Atlas
from processing.edge_placement import Placed, Placement
from processing.graph import Graph
from processing.occupancy_grid import Grid
from processing.pose_graph import marginal_covariances
from processing.shared_errors import scale_errors
from processing.trajectory import keyframe_poses, run_trajectory

if TYPE_CHECKING:
    from processing.pipeline import Config, DrivenRun

Array = NDArray[np.float64]


def assemble_atlas(
    runs: list["DrivenRun"],
    graph: Graph,
    placement: Placement,
    grids: list[Grid],
    config: "Config",
    remarks: list[str],
    left_out: list[dict[str, Any]],
) -> Atlas:
    trajectories = {}
    for number, driven in enumerate(runs):
        poses = keyframe_poses(placement.pieces, number, len(driven.loop.keyframes))
        trajectories[driven.run.run_id] = run_trajectory(driven.run, driven.loop, poses)
    document = {
        "schema": SCHEMA,
        "software": f"rtlog {version('rtlog')}",
        "parameters": asdict(config),
        "runs": [
            {
                "id": d.run.run_id,
                "sha256": d.run.sha256,
                "ticks": d.run.ticks,
                "profile": d.run.profile.name,
                "wheel_scale": _metres(d.wheels.scale),  # true over counted distance, as the laser saw it
            }
            for d in runs
        ],
        "nodes": [_node(k, runs, graph, placement) for k in range(len(graph.nodes))],
        "edges": [_edge(piece, runs, placement) for piece in placement.pieces],
        "left_out": left_out,
        "remarks": remarks,
    }
    edges: dict[str, Mapping[str, NDArray[Any]]] = {
        piece.solved.input.name: _arrays(piece, runs, grid) for piece, grid in zip(placement.pieces, grids, strict=True)
    }
    frames = np.array([piece.frame for piece in placement.pieces]).reshape(-1, 3)
    return Atlas(document, edges, trajectories, grids, frames)


def _metres(value: float) -> float:
    return round(float(value), 6)


def _node(k: int, runs: list["DrivenRun"], graph: Graph, placement: Placement) -> dict[str, Any]:
    x, y, theta = placement.nodes[k]
    passes = graph.nodes[k].passes
    return {
        "id": k,
        "epc": graph.nodes[k].epc,
        "x": _metres(x),
        "y": _metres(y),
        "theta": _metres(theta),
        "range": _metres(float(np.mean([found.range_m for _, found in passes if found.read]))),
        "part": int(placement.node_parts[k]),
        "passes": [
            {
                "run": runs[run].run.run_id,
                "tick": int(runs[run].run.scan_ticks[found.centre]),
                "range": _metres(found.range_m),
                "read": found.read,  # false: driven by without a read
            }
            for run, found in passes
        ],
    }


def _edge(piece: Placed, runs: list["DrivenRun"], placement: Placement) -> dict[str, Any]:
    of = piece.solved.input.piece
    kind = "edge" if of.j is not None else "spur" if of.i is not None else "run"
    chord = placement.nodes[of.j] - placement.nodes[of.i] if of.i is not None and of.j is not None else None
    strong = strong_links(piece)
    return {
        "id": piece.solved.input.name,
        "kind": kind,
        "i": of.i,
        "j": of.j,
        "length": None if chord is None else _metres(np.hypot(chord[0], chord[1])),
        "part": piece.part,
        "frame": [_metres(value) for value in piece.frame],
        "poses": len(piece.edge_poses),
        "links": {"weak": int((~strong).sum()), "strong": int(strong.sum())},
        "paths": [
            {
                "run": runs[span.run].run.run_id,
                "from": int(runs[span.run].run.scan_ticks[span.first]),
                "to": int(runs[span.run].run.scan_ticks[span.last]),
                "direction": -1 if of.j is not None and span.start == of.j else 1,
            }
            for span in of.spans
        ],
    }


def strong_links(piece: Placed) -> NDArray[np.bool_]:
    """Which links are scan matches of poses that are not neighbours on a path. The others are the chain of the drive,
    its odometry, and what a tag alone joins.
    """
    links = piece.solved.map.links
    path = np.searchsorted(piece.solved.map.firsts, links.ends, side="right")
    neighbours = (path[:, 0] == path[:, 1]) & (np.abs(links.ends[:, 1] - links.ends[:, 0]) == 1)
    return np.asarray(links.robust & ~neighbours)


def _arrays(piece: Placed, runs: list["DrivenRun"], grid: Grid) -> dict[str, NDArray[Any]]:
    solved = piece.solved
    ticks = [
        runs[span.run].run.scan_ticks[runs[span.run].loop.keyframes[path.keyframes]]
        for span, path in zip(solved.input.piece.spans, solved.input.paths, strict=True)
    ]
    stamps_ns = [
        runs[span.run].run.scans.stamps_ns[runs[span.run].loop.keyframes[path.keyframes]]
        for span, path in zip(solved.input.piece.spans, solved.input.paths, strict=True)
    ]
    spans = solved.input.piece.spans
    shared = scale_errors(
        solved.map.links,
        solved.map.firsts,
        np.array([span.run for span in spans]),
        np.array([runs[span.run].wheels.sigma for span in spans]),
    )
    return {
        "poses": piece.edge_poses,
        "covariances": marginal_covariances(piece.edge_poses, solved.map.links, solved.map.solution.weights, shared),
        "path_firsts": solved.map.firsts,
        "ticks": np.concatenate(ticks),
        "stamps_ns": np.concatenate(stamps_ns),
        "link_ends": solved.map.links.ends,
        "link_motions": solved.map.links.motions,
        "link_informations": solved.map.links.informations,
        "link_strong": strong_links(piece),
        "link_squared_distances": solved.map.solution.squared_distances,
        "grid_log_odds": grid.log_odds,
        "grid_resolution": np.array(grid.resolution_m),
        "grid_origin": np.asarray(grid.origin),
    }
