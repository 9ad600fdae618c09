"""What atlas.json must hold for its readers: checked where it is read, so that a damaged one is named in one line.

In: the parsed JSON. Out: nothing, or what is wrong and where. A document may hold more than this.
"""

from typing import Any, Literal

import msgspec
from msgspec import Struct

from hw_profiles.errors import BadInputError


class _Run(Struct):
    id: str
    sha256: str
    ticks: int
    profile: str
    scans: int = 0
    scans_unused: int = 0


class _Pass(Struct):
    run: str
    tick: int
    range: float


class _Node(Struct):
    id: int
    epc: str
    x: float
    y: float
    theta: float
    range: float
    part: int
    passes: list[_Pass]


class _Path(Struct):
    run: str
    first: int = msgspec.field(name="from")
    to: int
    direction: Literal[-1, 1]


class _Links(Struct):
    weak: int
    strong: int


class _Edge(Struct):
    id: str
    kind: Literal["edge", "spur", "run"]
    i: int | None
    j: int | None
    length: float | None
    part: int
    links: _Links
    paths: list[_Path]


class _LeftOut(Struct):
    what: str
    run: str
    ticks: list[int]
    reason: str


class _Conviction(Struct):
    run: str
    ticks: tuple[int, int]
    what: Literal["wheels", "scan", "tag", "profile"]
    how_much: str


class _Document(Struct):
    schema: int
    runs: list[_Run]
    nodes: list[_Node]
    edges: list[_Edge]
    remarks: list[str]
    left_out: list[_LeftOut] = []
    convictions: list[_Conviction] = []


def check_document(document: Any, source: str) -> None:
    """Raises: BadInputError: something is missing or is not what it should be."""
    try:
        found = msgspec.convert(document, _Document)
    except msgspec.ValidationError as error:
        raise BadInputError(f"{source}: {str(error).replace(' - at `$.', ' at `')}") from error
    nodes, runs = len(found.nodes), {run.id for run in found.runs}
    for edge in found.edges:
        if any(end is not None and not 0 <= end < nodes for end in (edge.i, edge.j)):
            raise BadInputError(f"{source}: edge {edge.id} ends at a node that is not there")
        if unknown := sorted({path.run for path in edge.paths} - runs):
            raise BadInputError(f"{source}: edge {edge.id} holds a path of {unknown[0]}, which is no run of it")
