"""The files of the edges: what each knows of itself, drawn and written wherever there is a process to spare.

In: a placed piece. Out: its npz as the atlas holds it, and its grid as the stitching wants it, both in a scratch
folder, so that memory follows the largest edge.
"""

import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from processing.edge_placement import Placed
from processing.occupancy_grid import StoredGrid, store_grid
from processing.pieces import draw_piece
from processing.pose_graph import marginal_covariances
from processing.shared_errors import scale_errors

if TYPE_CHECKING:
    from processing.pipeline import DrivenRun

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Edge:
    """A placed piece, and what of its runs goes into its file."""

    placed: Placed
    ticks: Ints  # (N,) of its key frames
    stamps_ns: Ints  # (N,)
    wheel_sigmas: Array  # (P,) of each path's run


@dataclass(frozen=True, slots=True)
class StoredEdge:
    arrays: Path  # the npz
    grid: StoredGrid


def edge_of(placed: Placed, runs: list["DrivenRun"]) -> Edge:
    given = placed.solved.input
    driven = [runs[span.run] for span in given.piece.spans]
    shown = [of.loop.keyframes[path.keyframes] for of, path in zip(driven, given.paths, strict=True)]
    return Edge(
        placed,
        np.concatenate([of.run.scan_ticks[rows] for of, rows in zip(driven, shown, strict=True)]),
        np.concatenate([of.run.scans.stamps_ns[rows] for of, rows in zip(driven, shown, strict=True)]),
        np.array([of.wheels.sigma for of in driven]),
    )


def store_edge(edge: Edge, resolution_m: float, folder: Path) -> StoredEdge:
    """Draw the grid and write both files. Raises: OSError: the disk is full."""
    placed, solved = edge.placed, edge.placed.solved
    grid = draw_piece(solved.input, solved.map.firsts, placed.edge_poses, resolution_m)
    runs = np.array([span.run for span in solved.input.piece.spans])
    shared = scale_errors(solved.map, runs, edge.wheel_sigmas)
    path = folder / f"{solved.input.name}.npz"
    write_npz(
        path,
        {
            "poses": placed.edge_poses,
            "covariances": marginal_covariances(
                placed.edge_poses, solved.map.links, solved.map.solution.weights, shared
            ),
            "path_firsts": solved.map.firsts,
            "ticks": edge.ticks,
            "stamps_ns": edge.stamps_ns,
            "link_ends": solved.map.links.ends,
            "link_motions": solved.map.links.motions,
            "link_informations": solved.map.links.informations,
            "link_strong": solved.map.strong,
            "link_squared_distances": solved.map.solution.squared_distances,
            "grid_log_odds": grid.log_odds,
            "grid_resolution": np.array(grid.resolution_m),
            "grid_origin": np.asarray(grid.origin),
        },
    )
    return StoredEdge(path, store_grid(grid, path.with_suffix(".npy")))


def write_npz(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """As numpy's savez_compressed, which knows only the slow way to compress."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
                np.lib.format.write_array(file, np.asarray(array), allow_pickle=False)
