"""The drives of all runs where the assembly has put their pieces, and where on them the tags were passed.

In: solved pieces and their frames. Out: what the joining of parts looks at: whole drives, not the pieces that they were
cut into at every tag.
"""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import overload

import numpy as np
from numpy.typing import NDArray

from processing.boundary import Boundary
from processing.geometry import compose
from processing.graph import Graph
from processing.part_joining import PlacedDrive, TagPass
from processing.pieces import SolvedPiece
from processing.scan_walls import Scan
from processing.sweeps import StoredScans

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class JoinedScans(Sequence[Scan]):
    """The scans of paths in a row, made when they are asked for; a pass that ends one and begins the next is there
    once.
    """

    paths: list[StoredScans]
    firsts: list[int]  # of each

    def __len__(self) -> int:
        return self.firsts[-1] + len(self.paths[-1])

    @overload
    def __getitem__(self, which: int) -> Scan: ...
    @overload
    def __getitem__(self, which: slice) -> Sequence[Scan]: ...
    def __getitem__(self, which: int | slice) -> Scan | Sequence[Scan]:
        if isinstance(which, slice):
            return [self[k] for k in range(*which.indices(len(self)))]
        path = int(np.searchsorted(self.firsts, which, side="right")) - 1
        return self.paths[path][which - self.firsts[path]]


def place_drives(pieces: list[SolvedPiece], frames: list[Array], parts: list[int]) -> list[PlacedDrive]:
    """By the number of the run; `frames` and parts of the pieces."""
    paths: dict[int, list[tuple[int, Array, StoredScans, int]]] = defaultdict(list)
    for piece, frame, part in zip(pieces, frames, parts, strict=True):
        poses = compose(frame, piece.map.poses)
        for p, (span, path) in enumerate(zip(piece.input.piece.spans, piece.input.paths, strict=True)):
            paths[span.run].append((int(path.keyframes[0]), poses[piece.map.path(p)], path.scans, part))
    drives = []
    for _, of in sorted(paths.items()):
        of.sort(key=lambda path: path[0])
        poses = np.zeros((of[-1][0] + len(of[-1][1]), 3))
        for first, at, _, _ in of:
            poses[first : first + len(at)] = at
        scans = [path[2] for path in of]
        drives.append(PlacedDrive(poses, JoinedScans(scans, [path[0] for path in of]), scans[0].sweeps.mount, of[0][3]))
    return drives


def find_tag_passes(pieces: list[SolvedPiece], boundary: Boundary, graph: Graph) -> list[TagPass]:
    """Every pass once, by run and place in it."""
    found: dict[tuple[int, int], TagPass] = {}
    reach_m = {(run, of.centre): of.range_m for node in graph.nodes for run, of in node.passes}
    for piece in pieces:
        for span, path in zip(piece.input.piece.spans, piece.input.paths, strict=True):
            for scan, node, index in ((span.first, span.start, 0), (span.last, span.end, -1)):
                if node is not None:
                    key = span.run, scan
                    variable = boundary.passes[key]
                    found[key] = TagPass(variable, node, span.run, int(path.keyframes[index]), reach_m.get(key, 0.0))
    return [found[key] for key in sorted(found)]
