"""The pieces of the map between the stages: what a run gives to a piece, and what comes back when it is solved.

In: open-loop runs and the graph. Out: solved pieces, each with its poses, its grid and where its passes are. A piece is
computed from its own arrays alone, so pieces can be solved in any order and anywhere.
"""

from dataclasses import dataclass, replace
from string import ascii_lowercase

import numpy as np
from numpy.typing import NDArray

from processing.edge_map import Path, PieceMap, map_piece
from processing.geometry import compose
from processing.graph import Piece, Span
from processing.occupancy_grid import Grid, View, build_grid
from processing.open_loop import OpenLoop
from processing.registration import path_starts
from processing.scan_matching import Matcher
from processing.sweeps import StoredScans, Sweeps

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

GRID_SPACING_M = 0.3  # scans closer to each other than this add nothing to a grid


@dataclass(frozen=True, slots=True)
class Sight:
    """The scans of a span that go into the grid: s, seen from key frames of their path."""

    sweeps: Sweeps  # of the span
    rows: Ints  # (s,) which of them
    keyframe: Ints  # (s,) of the path
    offsets: Array  # (s, 3) of the vehicle, in the frame of that key frame


@dataclass(frozen=True, slots=True)
class PieceInput:
    name: str
    piece: Piece
    paths: tuple[Path, ...]
    sights: tuple[Sight, ...]


@dataclass(frozen=True, slots=True)
class SolvedPiece:
    input: PieceInput
    map: PieceMap

    def scan(self, index: int) -> StoredScans:
        """That of one of the N key frames, alone."""
        p = self.path_of(index)
        return self.input.paths[p].scans.alone(index - int(self.map.firsts[p]))

    def keyframe(self, index: int) -> tuple[str, int]:
        """Of which run it is, and which of its key frames."""
        p = self.path_of(index)
        path = self.input.paths[p]
        return path.run_id, int(path.keyframes[index - int(self.map.firsts[p])])

    @property
    def mounts(self) -> Array:
        """(N, 3) of the scanners of all key frames in their vehicles."""
        return np.repeat([sight.sweeps.mount for sight in self.input.sights], np.diff(self.map.firsts), axis=0)

    def path_of(self, index: int) -> int:
        return int(np.searchsorted(self.map.firsts, index, side="right")) - 1

    def ends(self, p: int) -> tuple[int, int]:
        """Indices of the first and last pose of path `p`."""
        return int(self.map.firsts[p]), int(self.map.firsts[p + 1]) - 1


def cut_span(run_id: str, loop: OpenLoop, span: Span) -> tuple[Path, Sight]:
    """What one span gives to its piece; the passes at its ends are key frames."""
    a, b = (int(np.searchsorted(loop.keyframes, scan)) for scan in (span.first, span.last))
    chain = loop.links[np.arange(a, b)].shifted(-a)
    wheels = loop.wheels[np.arange(a, b)].shifted(-a)
    sweeps = loop.sweeps.cut(span.first, span.last)
    scans = StoredScans(sweeps, loop.keyframes[a : b + 1] - span.first)
    path = Path(run_id, np.arange(a, b + 1), scans, chain, wheels, np.zeros(3))
    travelled = np.append(0.0, np.cumsum(np.hypot(*loop.odometry.deltas[span.first : span.last, :2].T)))
    rows = np.unique(np.floor(travelled / GRID_SPACING_M), return_index=True)[1]
    shown = span.first + rows
    return path, Sight(sweeps, rows, np.clip(loop.reference[shown] - a, 0, b - a), loop.offsets[shown])


def split_drifts(given: PieceInput) -> list[PieceInput]:
    """Register the paths of a piece to each other; two drifts between the same two tags become two pieces."""
    starts, groups, doubts_m = path_starts(
        chains=[path.chain for path in given.paths],
        scans=[path.scans for path in given.paths],
        ends=[(span.start, span.end) for span in given.piece.spans],
        reaches_m=[span.reaches_m for span in given.piece.spans],
        mounts=[sight.sweeps.mount for sight in given.sights],
    )
    out = []
    for number, leader in enumerate(dict.fromkeys(groups)):
        chosen = [p for p, group in enumerate(groups) if group == leader]
        out.append(
            PieceInput(
                given.name + drift_suffix(number),
                replace(given.piece, spans=tuple(given.piece.spans[p] for p in chosen)),
                tuple(replace(given.paths[p], start=starts[p], start_doubt_m=doubts_m[p]) for p in chosen),
                tuple(given.sights[p] for p in chosen),
            )
        )
    return out


def drift_suffix(number: int) -> str:
    """Nothing for the first drift between two tags, then b, c … z, z2, z3 …: each piece has a name of its own."""
    if number == 0:
        return ""
    return ascii_lowercase[number] if number < 26 else f"z{number - 24}"


def rename(parts: list[SolvedPiece], name: str) -> list[SolvedPiece]:
    """The drifts of one piece under another name."""
    return [replace(of, input=replace(of.input, name=name + drift_suffix(k))) for k, of in enumerate(parts)]


def solve_piece(given: PieceInput, match: Matcher) -> list[SolvedPiece]:
    return [SolvedPiece(part, map_piece(list(part.paths), match)) for part in split_drifts(given)]


def draw_piece(given: PieceInput, firsts: Ints, poses: Array, resolution_m: float) -> Grid:
    """The occupancy grid of a piece, in the frame of the key frames' poses (N, 3)."""
    views = []
    for p, sight in enumerate(given.sights):
        laser = compose(compose(poses[firsts[p] + sight.keyframe], sight.offsets), sight.sweeps.mount)
        ranges = sight.sweeps.ranges[sight.rows]
        views.append(View(laser, sight.sweeps.straighten(ranges, sight.rows), ranges, sight.sweeps.angles))
    return build_grid(views, resolution_m)
