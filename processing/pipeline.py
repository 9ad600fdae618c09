"""The whole method in one screen: runs as they were read in, atlas out.

runs ─ ready_runs ─ open_loop ─┐
                               graph ─ pieces (edge_map) ─ assembly ─ edge_files ─ map_files ─ Atlas
                                 └─────── tags missed ◄───────┘
"""

from collections import Counter
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hw_profiles.errors import RTLogError
from processing.atlas import Atlas, write_atlas
from processing.atlas_document import assemble_atlas
from processing.beacons import Pass
from processing.build import Config
from processing.calibration import WheelScale
from processing.edge_files import edge_of, store_edge
from processing.edge_placement import Placement, place_by_frames
from processing.graph import Graph, Piece, build_graph
from processing.length_placement import place_by_lengths
from processing.map_files import StoredImage, stitch_image
from processing.open_loop import (
    OpenLoop,
    cut_segments,
    drive_segment,
    join_segments,
)
from processing.pieces import PieceInput, SolvedPiece, cut_span, rename, solve_piece
from processing.polar_matching import match_polar
from processing.polar_scan import ranges_at
from processing.read_log import Run
from processing.ready_runs import ReadyRun, make_ready
from processing.remarks import remarks
from processing.scan_match import ScanMatch
from processing.scan_matching import Matcher, match_scans
from processing.scan_walls import Scan, prepare_scan
from processing.tag_review import add_missed, leave_out_moved
from processing.workers import Workers

Array = NDArray[np.float64]

MAX_REVIEWS = 2  # a pass that was not read may only show when another one has been put in


def match_polar_scans(reference: Scan, current: Scan, guess: Array) -> ScanMatch:
    """Polar scan matching on scans as the other stages keep them."""
    angles = reference.angle_min + reference.angle_increment * np.arange(len(reference.points), dtype=np.float64)
    return match_polar(ranges_at(angles, reference.points), ranges_at(angles, current.points), angles, guess)


MATCHERS: dict[str, Matcher] = {"point-to-line": match_scans, "psm": match_polar_scans}


@dataclass(frozen=True, slots=True)
class DrivenRun:
    run: Run
    wheels: WheelScale
    put_right: list[str]  # what its profile or its stamps said wrongly
    loop: OpenLoop
    passes: list[Pass]


def map_runs(runs: list[Run], config: Config, output: Path, scratch: Path, work: Workers) -> Atlas:
    """Map what was read, and write the atlas. Raises: as `processing.build.build`."""
    match = MATCHERS[config.matcher]
    ready = make_ready(runs, config.method == "landmark", work)
    driven, left_out = leave_out_moved(drive_through(ready, work, match))
    driven, graph, placed = map_network(driven, work, match, config)
    edges, image = draw(driven, placed, config.resolution_m, scratch, work)
    atlas = assemble_atlas(driven, graph, placed, config, remarks(driven, placed), left_out)
    write_atlas(output, atlas, edges, image, work)
    return atlas


def warm_up() -> None:
    """Load the kernels that take longest: a quarter of a second for the first of them, in every process that was not
    forked after.
    """
    scan = prepare_scan(np.zeros((3, 2)), 0.0, 0.1)
    match_scans(scan, scan, np.zeros(3))


def map_network(
    runs: list[DrivenRun], work: Workers, match: Matcher, config: Config
) -> tuple[list[DrivenRun], Graph, Placement]:
    """Solve the pieces and assemble them; again, as far as they changed, where the map shows passes without a read."""
    place = partial(place_by_frames, known={}) if config.assembly == "refined" else place_by_lengths
    known: dict[Piece, list[SolvedPiece]] = {}
    for review in range(MAX_REVIEWS + 1):
        graph = build_graph([run.passes for run in runs], [len(run.loop) for run in runs])
        names = dict(zip(graph.pieces, piece_names(graph), strict=True))
        new = [piece for piece in graph.pieces if piece not in known]
        inputs = [piece_input(names[piece], piece, runs) for piece in new]
        known |= dict(zip(new, work.map("pieces", partial(solve_piece, match=match), inputs), strict=True))
        solved = [part for piece in graph.pieces for part in rename(known[piece], names[piece])]
        placed = place(solved, graph, match, work)
        reviewed = add_missed(runs, placed, match)
        if reviewed is None or review == MAX_REVIEWS:
            break
        runs = reviewed
    return runs, graph, placed


def drive_through(runs: list[ReadyRun], work: Workers, match: Matcher) -> list[DrivenRun]:
    """Estimate the runs open loop; every pass becomes a key frame."""
    driven = work.map_groups(
        "runs",
        partial(drive_segment, match=match),
        [cut_segments(of.sweeps, of.odometry, np.array([p.centre for p in of.passes], np.int64)) for of in runs],
    )
    return [
        DrivenRun(of.run, of.wheels, of.put_right, join_segments(of.sweeps, of.odometry, segments), of.passes)
        for of, segments in zip(runs, driven, strict=True)
    ]


def piece_names(graph: Graph) -> list[str]:
    """`i-j` for an edge, `i-spur`, `i-spur2` … for the spurs of a node, `run-k` for a run without tags."""
    names, spurs = [], Counter[int | None]()
    for piece in graph.pieces:
        if piece.j is not None:
            names.append(f"{piece.i}-{piece.j}")
        elif piece.i is None:
            names.append(f"run-{piece.spans[0].run}")
        else:
            spurs[piece.i] += 1
            names.append(f"{piece.i}-spur{spurs[piece.i] if spurs[piece.i] > 1 else ''}")
    return names


def piece_input(name: str, piece: Piece, runs: list[DrivenRun]) -> PieceInput:
    cuts = [cut_span(runs[s.run].run.run_id, runs[s.run].loop, s) for s in piece.spans]
    paths, sights = (tuple(column) for column in zip(*cuts, strict=True))
    return PieceInput(name, piece, paths, sights)


def draw(
    runs: list[DrivenRun], placed: Placement, resolution_m: float, scratch: Path, work: Workers
) -> tuple[list[Path], StoredImage]:
    """The files of the edges, and the stitched picture; all of it in the scratch folder."""
    store = partial(store_edge, resolution_m=resolution_m, folder=scratch)
    frames = np.array([piece.frame for piece in placed.pieces])
    try:
        edges = work.map("edges", store, [edge_of(piece, runs) for piece in placed.pieces])
        image = stitch_image([edge.grid for edge in edges], frames, scratch / "map", work)
    except OSError as error:
        raise RTLogError(f"{scratch}: no room for the grids: {error.strerror or error}; set TMPDIR") from error
    return [edge.arrays for edge in edges], image
