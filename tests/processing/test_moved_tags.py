"""Moved tags: told by the distances to their neighbours, on drives along a line whose tags are known by hand."""

import numpy as np
import pytest

from processing.beacons import Pass
from processing.moved_tags import OpenPasses, PassId, find_moved

A, B, C, D, T = (f"E200000000000000000000{letter}{letter}" for letter in "ABCDF")


def drive(*visits: tuple[str, float], scale: float = 1.0, turned: float = 0.0) -> OpenPasses:
    """A run along a line: tags and where they are passed [m], seen by wheels that are wrong by `scale`."""
    place = scale * np.array([x for _, x in visits], float)
    way = np.append(0.0, np.cumsum(np.abs(np.diff(place))))
    passes = [Pass(epc, 10 * k, 10 * k - 2, 10 * k + 2, 0.0, 0.0, 2.0) for k, (epc, _) in enumerate(visits)]
    return OpenPasses(passes, np.column_stack([place * np.cos(turned), place * np.sin(turned)]), way)


def unlike(_first: PassId, _second: PassId) -> bool:
    return False


def alike(_first: PassId, _second: PassId) -> bool:
    return True


def only_first_alike(first: PassId, _second: PassId) -> bool:
    return first[1] == 0


PLAIN = [(A, 0), (B, 50), (T, 100), (C, 150), (D, 200)]


def test_tags_that_stay_are_let_be_whatever_the_wheels_and_the_direction() -> None:
    back = [(epc, 200 - x) for epc, x in PLAIN[::-1]]
    runs = [drive(*PLAIN), drive(*PLAIN, scale=1.02, turned=2.0), drive(*back), drive(*PLAIN, *PLAIN[::-1])]
    assert find_moved(runs, unlike) == []


@pytest.mark.parametrize("to", [75.0, 130.0, 175.0])
def test_a_tag_that_was_moved_between_runs_is_named(to: float) -> None:
    runs = [
        drive(*PLAIN),
        drive((A, 0), (B, 50), (C, 150), (D, 200)),
        drive(*sorted([*PLAIN[:2], *PLAIN[3:], (T, to)], key=lambda v: v[1])),
    ]
    assert find_moved(runs, unlike) == [T]
    assert find_moved(runs[::-1], unlike) == [T]


def test_a_tag_that_was_moved_during_a_run_is_named() -> None:
    there_and_back = [*PLAIN, (D, 200), (C, 150), (T, 70), (B, 50), (A, 0)]
    assert find_moved([drive(*there_and_back)], unlike) == [T]


def test_one_epc_at_two_places_is_named_even_without_another_tag() -> None:
    assert find_moved([drive((T, 0), (T, 40))], unlike) == [T]
    assert find_moved([drive((T, 0), (T, 4), (T, 0))], unlike) == []  # to and fro under it


def test_several_moved_tags_are_all_named_and_no_other() -> None:
    moved = [(A, 0), (B, 50), (C, 110), (T, 130), (D, 200), ("E2AA", 240), ("E2BB", 270)]
    assert find_moved([drive(*PLAIN, ("E2AA", 240), ("E2BB", 270)), drive(*moved)], unlike) == [C, T]


def test_of_two_tags_the_walls_tell_which_was_moved() -> None:
    runs = [drive((A, 0), (T, 60)), drive((A, 0), (T, 90))]
    assert find_moved(runs, only_first_alike) == [T]
    assert find_moved(runs, unlike) == [A, T]  # nothing tells: neither can be believed


def test_walls_that_are_the_same_outweigh_open_loop() -> None:
    strayed = drive((A, 0), (B, 50), (T, 130), (C, 180), (D, 230))  # 30 m too far between two tags
    assert find_moved([drive(*PLAIN), strayed], alike) == []


def test_what_open_loop_may_be_wrong_by_moves_no_tag() -> None:
    far = [drive((A, 0), (T, 1000)), drive((A, 0), (T, 1030))]  # 3 % of the way
    assert find_moved(far, unlike) == []
    assert find_moved([drive((A, 0), (T, 1000)), drive((A, 0), (T, 1080))], unlike) == [A, T]


def test_runs_without_a_tag_in_common_say_nothing() -> None:
    assert find_moved([drive((A, 0), (B, 10)), drive((C, 0), (D, 90)), drive()], unlike) == []
