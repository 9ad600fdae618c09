"""The graph of drifts: beacons are nodes, and every drive between two passes belongs to an edge (paper, section 2.3).

In: the passes of every run, in driving order. Out: nodes, and the pieces of the map with the spans of the runs in them.

    run   ───────●────────────●──────────────●─────────●───
                 A            B              B         C        passes
          spur of A   edge A–B   turn-around     edge B–C  spur of C
                                 (spur of B)

The lower EPC is the origin of an edge. A span driven the other way round belongs to the same edge. What touches only
one node (before the first tag, after the last, out and back) is a spur of that node, each for itself: nothing says yet
which of them lie in the same drift. A run without any tag is a piece of its own.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

from processing.beacons import Pass


@dataclass(frozen=True, slots=True)
class Span:
    """A stretch of one run, from scan `first` to scan `last`, both included; neighbours in a run share the scan of the
    pass.
    """

    run: int
    first: int
    last: int
    start: int | None  # node at the first scan
    end: int | None  # node at the last scan
    reaches_m: tuple[float, float] = field(default=(0.0, 0.0), compare=False)  # how far those nodes' tags are read


@dataclass(frozen=True, slots=True)
class Node:
    epc: str
    passes: tuple[tuple[int, Pass], ...]  # (run, pass)


@dataclass(frozen=True, slots=True)
class Piece:
    """What is mapped in one go: an edge (i < j), a spur of a node (j None), or a run without tags (both None)."""

    i: int | None
    j: int | None
    spans: tuple[Span, ...]


@dataclass(frozen=True, slots=True)
class Graph:
    nodes: tuple[Node, ...]  # by ascending EPC
    pieces: tuple[Piece, ...]


def build_graph(passes: Sequence[Sequence[Pass]], scan_counts: Sequence[int]) -> Graph:
    """One list of passes and one number of scans a run."""
    epcs = sorted({found.epc for run in passes for found in run})
    number = {epc: k for k, epc in enumerate(epcs)}
    reaches_m = [0.0] * len(epcs)
    for single in (single for found in passes for single in found):
        reaches_m[number[single.epc]] = max(reaches_m[number[single.epc]], single.range_m)
    visits: list[list[tuple[int, Pass]]] = [[] for _ in epcs]
    spans: dict[tuple[int, int, int, int], list[Span]] = {}
    for run, (found, count) in enumerate(zip(passes, scan_counts, strict=True)):
        for single in found:
            visits[number[single.epc]].append((run, single))
        for span in _cut(run, found, count, number, reaches_m):
            spans.setdefault(_key(span), []).append(span)
    nodes = tuple(Node(epc, tuple(of)) for epc, of in zip(epcs, visits, strict=True))
    pieces = []
    for (i, j, _, _), members in sorted(spans.items()):
        pieces.append(Piece(i if i >= 0 else None, j if j >= 0 else None, tuple(members)))
    return Graph(nodes, tuple(pieces))


def _cut(
    run: int, passes: Sequence[Pass], count: int, number: dict[str, int], reaches_m: Sequence[float]
) -> list[Span]:
    """The spans of a run, cut at the centres of its passes."""
    cuts: list[tuple[int, int | None]] = [(0, None)]
    cuts += [(found.centre, number[found.epc]) for found in passes]
    cuts += [(count - 1, None)]

    def reach_m(node: int | None) -> float:
        return 0.0 if node is None else reaches_m[node]

    return [
        Span(run, first, last, start, end, (reach_m(start), reach_m(end)))
        for (first, start), (last, end) in pairwise(cuts)
        if last > first
    ]


def _key(span: Span) -> tuple[int, int, int, int]:
    """Spans with the same key are mapped together: those of an edge. All others stay alone."""
    ends = sorted(node for node in (span.start, span.end) if node is not None)
    if len(ends) == 2 and ends[0] != ends[1]:
        return (ends[0], ends[1], 0, 0)
    return (ends[0] if ends else -1, -1, span.run, span.first)
