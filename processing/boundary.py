"""The boundary of the pieces: those of their poses that the assembly reckons with.

In: solved pieces. Out: the variables of the assembly. A pass ends one piece and begins the next: that is one variable,
and joins the two rigidly; key frames that links join to another piece are added later.
"""

from dataclasses import dataclass

from processing.pieces import SolvedPiece


@dataclass(slots=True)
class Boundary:
    """Which poses of the pieces are the same variable of the assembly: a pass ends one piece and begins the next."""

    indices: list[list[int]]  # per piece: poses
    variables: list[list[int]]  # per piece: their variables
    passes: dict[tuple[int, int], int]  # (run, scan) → variable
    nodes: dict[int, int]  # variable → node
    count: int = 0  # of the variables

    def add(self, piece: int, index: int) -> int:
        """A variable for a pose within a piece, new or known."""
        if index in self.indices[piece]:
            return self.variables[piece][self.indices[piece].index(index)]
        return self.put(piece, index, self.count)

    def put(self, piece: int, index: int, variable: int) -> int:
        self.indices[piece].append(index)
        self.variables[piece].append(variable)
        self.count = max(self.count, variable + 1)
        return variable

    def passes_of_nodes(self) -> dict[int, list[int]]:
        """Node → the variables of its passes, ascending; the nodes ascend too."""
        found: dict[int, list[int]] = {node: [] for node in sorted(set(self.nodes.values()))}
        for variable in sorted(self.nodes):
            found[self.nodes[variable]].append(variable)
        return found


def find_boundary(solved: list[SolvedPiece]) -> Boundary:
    boundary = Boundary([[] for _ in solved], [[] for _ in solved], {}, {})
    for p, piece in enumerate(solved):
        for k, span in enumerate(piece.input.piece.spans):
            for index, scan, node in zip(piece.ends(k), (span.first, span.last), (span.start, span.end), strict=True):
                if node is None:
                    continue
                known = boundary.passes.get((span.run, scan))
                variable = boundary.count if known is None else known
                boundary.passes[span.run, scan] = variable
                boundary.nodes[variable] = node
                boundary.put(p, index, variable)
        if not boundary.indices[p]:
            boundary.add(p, 0)
    return boundary
