"""The graph: which spans of which runs belong to which piece of the map."""

import pytest

from processing.beacons import Pass
from processing.graph import Piece, Span, build_graph

A, B, C, D = (f"E200000000000000000000{letter}{letter}" for letter in "ABCD")  # nodes 0, 1, 2, 3


def run(*visits: tuple[str, int]) -> list[Pass]:
    return [Pass(epc, centre, centre - 2, centre + 2, 0.0, 0.0, 0.5) for epc, centre in visits]


def pieces(*runs: list[Pass], scans: int = 100) -> dict[tuple[int | None, int | None], list[Span]]:
    """The spans by the ends of their pieces; of spurs, those of all that hang on the same node."""
    found: dict[tuple[int | None, int | None], list[Span]] = {}
    for piece in build_graph(runs, [scans] * len(runs)).pieces:
        assert piece.j is None or (piece.i, piece.j) not in found
        assert piece.j is not None or len(piece.spans) == 1  # every spur is mapped by itself
        found.setdefault((piece.i, piece.j), []).extend(piece.spans)
    return found


def test_a_drive_past_three_tags() -> None:
    assert pieces(run((A, 10), (B, 40), (C, 70))) == {
        (0, None): [Span(0, 0, 10, None, 0)],
        (0, 1): [Span(0, 10, 40, 0, 1)],
        (1, 2): [Span(0, 40, 70, 1, 2)],
        (2, None): [Span(0, 70, 99, 2, None)],
    }


def test_the_lower_epc_is_the_origin_and_both_directions_are_one_edge() -> None:
    found = pieces(run((B, 10), (A, 50), (B, 90)))
    assert found[0, 1] == [Span(0, 10, 50, 1, 0), Span(0, 50, 90, 0, 1)]
    assert (1, 0) not in found


def test_a_turn_around_is_a_spur_of_its_node() -> None:
    found = pieces(run((A, 10), (B, 40), (B, 60), (A, 90)))
    assert found[1, None] == [Span(0, 40, 60, 1, 1)]
    assert found[0, None] == [Span(0, 0, 10, None, 0), Span(0, 90, 99, 0, None)]
    assert found[0, 1] == [Span(0, 10, 40, 0, 1), Span(0, 60, 90, 1, 0)]


def test_a_missed_tag_makes_an_edge_of_its_own() -> None:
    found = pieces(run((A, 10), (B, 40), (C, 70)), run((A, 10), (C, 70)))
    assert found[0, 2] == [Span(1, 10, 70, 0, 2)]


def test_runs_merge_by_their_tags() -> None:
    graph = build_graph([run((A, 10), (B, 40)), run((C, 5), (B, 20), (A, 30))], [50, 35])
    assert [node.epc for node in graph.nodes] == [A, B, C]
    assert [[(r, p.centre) for r, p in node.passes] for node in graph.nodes] == [
        [(0, 10), (1, 30)],
        [(0, 40), (1, 20)],
        [(1, 5)],
    ]
    edge = next(piece for piece in graph.pieces if (piece.i, piece.j) == (0, 1))
    assert edge.spans == (Span(0, 10, 40, 0, 1), Span(1, 20, 30, 1, 0))
    spurs = [piece.spans for piece in graph.pieces if (piece.i, piece.j) == (0, None)]
    assert spurs == [(Span(0, 0, 10, None, 0),), (Span(1, 30, 34, 0, None),)]


def test_runs_without_tags_are_pieces_of_their_own() -> None:
    graph = build_graph([[], run((A, 50)), []], [100, 100, 7])
    assert graph.pieces == (
        Piece(None, None, (Span(0, 0, 99, None, None),)),
        Piece(None, None, (Span(2, 0, 6, None, None),)),
        Piece(0, None, (Span(1, 0, 50, None, 0),)),
        Piece(0, None, (Span(1, 50, 99, 0, None),)),
    )


def test_a_run_of_one_tag_is_all_spurs() -> None:
    assert list(pieces(run((D, 30)))) == [(0, None)]


@pytest.mark.parametrize(
    "visits",
    [
        [(A, 0), (B, 99)],
        [(B, 0), (A, 50), (C, 51), (A, 99)],
        [(A, 10), (A, 60), (B, 70), (C, 71), (C, 98)],
        [],
    ],
)
def test_the_spans_of_a_run_cover_it_and_share_the_scans_of_its_passes(visits: list[tuple[str, int]]) -> None:
    found = pieces(run(*visits))
    spans = sorted((span for members in found.values() for span in members), key=lambda span: span.first)
    cuts = [span.first for span in spans] + [spans[-1].last]
    assert cuts == sorted({0, *(centre for _, centre in visits), 99})
    assert [a.last for a in spans[:-1]] == [b.first for b in spans[1:]]
    assert [a.end for a in spans[:-1]] == [b.start for b in spans[1:]]
    assert all(span.last > span.first for span in spans)
    epcs = sorted({epc for epc, _ in visits})
    for (i, j), members in found.items():
        for span in members:
            ends = {node for node in (span.start, span.end) if node is not None}
            assert ends == {node for node in (i, j) if node is not None}
            assert i is None or j is None or epcs[i] < epcs[j]


def test_the_order_of_the_runs_changes_no_node() -> None:
    first, second = run((C, 10), (A, 20)), run((B, 10), (A, 20))
    one, other = build_graph([first, second], [50, 50]), build_graph([second, first], [50, 50])
    assert [node.epc for node in one.nodes] == [node.epc for node in other.nodes]
    assert [(p.i, p.j) for p in one.pieces] == [(p.i, p.j) for p in other.pieces]


def test_a_span_knows_how_far_its_tags_are_read_by_any_run() -> None:
    far = [Pass(A, 20, 10, 30, 0.0, 0.0, 7.5)]
    (edge,) = [piece for piece in build_graph([run((A, 10), (B, 40)), far], [100, 100]).pieces if piece.j is not None]
    assert edge.spans[0].reaches_m == (7.5, 0.5)
