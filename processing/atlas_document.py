"""From the stages' records to the atlas: what stands in atlas.json and in the trajectories."""

from dataclasses import asdict
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

import numpy as np

from processing.atlas import SCHEMA, Atlas
from processing.convictions import convictions
from processing.edge_placement import Placed, Placement
from processing.graph import Graph
from processing.trajectory import keyframe_poses, run_trajectory

if TYPE_CHECKING:
    from processing.build import Config
    from processing.pipeline import DrivenRun


def assemble_atlas(
    runs: list["DrivenRun"],
    graph: Graph,
    placement: Placement,
    config: "Config",
    remarks: list[str],
    left_out: list[dict[str, Any]],
) -> Atlas:
    """`remarks` and `left_out`: what the user should know, besides the witnesses that were convicted."""
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
                "scans": len(d.loop.matched),
                "scans_unused": int((~d.loop.matched[1:]).sum()),  # those that odometry alone carries
            }
            for d in runs
        ],
        "nodes": [_node(k, runs, graph, placement) for k in range(len(graph.nodes))],
        "edges": [_edge(piece, runs, placement) for piece in placement.pieces],
        "convictions": [of for driven in runs for of in convictions(driven)] + [_of_tag(item) for item in left_out],
        "left_out": left_out,
        "remarks": remarks,
    }
    return Atlas(document, trajectories)


def _of_tag(item: dict[str, Any]) -> dict[str, Any]:
    """What was left out of a run, as a conviction of the tag."""
    ends = [min(item["ticks"]), max(item["ticks"])]
    return {"run": item["run"], "ticks": ends, "what": "tag", "how_much": f"{item['what']}: {item['reason']}"}


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
    strong = piece.solved.map.strong
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
