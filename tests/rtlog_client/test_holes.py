"""Holes: for any order of arrival the count is what a set of numbers says."""

from hypothesis import given
from hypothesis import strategies as st

from rtlog_client.holes import SequenceHoles


@given(st.integers(0, 20), st.lists(st.tuples(st.booleans(), st.integers(0, 40)), max_size=80))
def test_any_order_agrees_with_a_set(first: int, events: list[tuple[bool, int]]) -> None:
    holes = SequenceHoles(first)
    received: set[int] = set()
    lowest, highest = first, first - 1
    for is_sample, number in events:
        highest = max(highest, number)
        if is_sample:
            assert holes.add(number) == (number not in received)
            received.add(number)
            lowest = min(lowest, number)
        else:
            holes.published_up_to(number)
    missing = set(range(lowest, highest + 1)) - received
    assert holes.lost == len(missing)
    assert holes.received == len(received)
    assert {k for start, stop in holes.holes for k in range(start, stop + 1)} == missing
    assert all(a[1] + 1 < b[0] for a, b in zip(holes.holes, holes.holes[1:], strict=False))


def test_what_came_before_us_is_no_hole() -> None:
    holes = SequenceHoles(13)
    for number in (13, 14, 17, 17):
        holes.add(number)
    holes.published_up_to(19)
    assert (holes.received, holes.lost, holes.holes) == (3, 4, [(15, 16), (18, 19)])
    holes.add(16)
    assert holes.holes == [(15, 15), (18, 19)]
