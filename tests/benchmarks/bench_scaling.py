"""How time and memory grow with the length of the network, and how long an assembly of 10,000 edges takes.

Networks of 1, 2 and 5 km, every drift driven once and every junction crossed on both of its drifts; with --all also 9
and 21 km. CPU time, so that what else runs on the machine does not bend the line.
"""

import argparse
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from building import build, network
from network_world import length_m
from table import Figure, report

from processing.assembly import assemble_paper
from processing.condensed import Condensed
from processing.frame_assembly import lay_out, solve_frames
from processing.geometry import compose, relative, wrap_angle
from processing.pose_graph import Links

BLOCKS, MORE_BLOCKS = (2, 3, 5), (7, 11)
MOST_SLOPE, MOST_ASSEMBLY_S = 1.1, 5.0
SIDE = 71  # a net of 71 × 71 nodes has 9,940 edges


def town(side: int) -> tuple[np.ndarray, np.ndarray]:
    """Nodes (n, 2) of a net with unequal streets, and its edges (m, 2)."""
    x, y = np.meshgrid(np.arange(side), np.arange(side), indexing="ij")
    nodes = 80.0 * np.column_stack([x.ravel(), y.ravel()]) + np.random.default_rng(2).uniform(-15, 15, (side * side, 2))
    number = np.arange(side * side).reshape(side, side)
    rows = np.column_stack([number[:, :-1].ravel(), number[:, 1:].ravel()])
    columns = np.column_stack([number[:-1].ravel(), number[1:].ravel()])
    return nodes, np.concatenate([rows, columns])


def assemble_by_lengths(nodes: np.ndarray, edges: np.ndarray) -> float:
    """Seconds of the paper's assembly: a turn from every edge to the next ones at its end."""
    rng = np.random.default_rng(3)
    along = nodes[edges[:, 1]] - nodes[edges[:, 0]]
    angles = np.arctan2(along[:, 1], along[:, 0])
    leaving: dict[int, list[int]] = {}
    for e, (a, _) in enumerate(edges.tolist()):
        leaving.setdefault(a, []).append(e)
    pairs = np.array([(e, f) for e, (_, b) in enumerate(edges.tolist()) for f in leaving.get(b, [])])
    turns = wrap_angle(angles[pairs[:, 1]] - angles[pairs[:, 0]] + rng.normal(0, 0.01, len(pairs)))
    began = time.process_time()
    assembly = assemble_paper(len(nodes), edges, np.hypot(along[:, 0], along[:, 1]), pairs, turns)
    seconds = time.process_time() - began
    assert assembly.converged
    assert not assembly.violated
    return seconds


def assemble_by_frames(nodes: np.ndarray, edges: np.ndarray) -> float:
    """Seconds of the refined assembly: every edge a relative pose of its two nodes."""
    rng = np.random.default_rng(4)
    poses = np.column_stack([nodes, rng.uniform(-3, 3, len(nodes))])
    sigmas = np.array([0.05, 0.05, 0.005])
    motions = compose(relative(poses[edges[:, 0]], poses[edges[:, 1]]), rng.normal(0, sigmas, (len(edges), 3)))
    pieces = [
        Condensed(ends, np.vstack([np.zeros(3), motion]), np.diag(1 / sigmas))
        for ends, motion in zip(edges, motions, strict=True)
    ]
    none = Links.of(np.empty((0, 2)), np.empty((0, 3)), np.empty((0, 3, 3)), robust=True)
    fixed = np.arange(len(nodes)) == 0
    began = time.process_time()
    guess, _, _ = lay_out(pieces, none, len(nodes))
    solved, _ = solve_frames(guess, pieces, none, fixed)
    seconds = time.process_time() - began
    off = relative(solved[edges[:, 0]], solved[edges[:, 1]]) - motions
    assert np.abs(off[:, :2]).max() < 1.0
    return seconds


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--all", action="store_true", help="also 9 and 21 km")
    blocks = BLOCKS + MORE_BLOCKS * parser.parse_args().all
    figures, seconds, peaks = [], [], []
    for count in blocks:
        recordings = network(count)
        with tempfile.TemporaryDirectory() as folder:
            built = build(recordings, Path(folder) / "network.atlas")
        seconds.append(built.cpu_s)
        peaks.append(built.peak_mb)
        figures += [
            Figure(f"{length_m(count) / 1e3:.1f} km: CPU", built.cpu_s, "s"),
            Figure(f"{length_m(count) / 1e3:.1f} km: peak memory", built.peak_mb, "MB"),
        ]
    kilometres = np.array([length_m(count) / 1e3 for count in blocks])
    slope = np.polyfit(np.log(kilometres), np.log(seconds), 1)[0]
    growth = np.polyfit(kilometres, peaks, 1)[0]
    nodes, edges = town(SIDE)
    figures += [
        Figure("slope of log time against log length", float(slope), "", most=MOST_SLOPE),
        Figure("memory for every further kilometre", float(growth), "MB"),
        Figure(f"assembly of {len(edges)} edges, refined", assemble_by_frames(nodes, edges), "s", most=MOST_ASSEMBLY_S),
        Figure(f"assembly of {len(edges)} edges, paper", assemble_by_lengths(nodes, edges), "s", most=MOST_ASSEMBLY_S),
    ]
    return report("growth with the network", figures)


if __name__ == "__main__":
    sys.exit(main())
