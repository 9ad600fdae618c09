"""Beacons: where a tag was passed, on drives whose reads are known by hand."""

import numpy as np
import pytest

from processing.beacons import Pass, find_passes, overlapping_passes, thin_passes

A, B, C = "E2000000000000000000000A", "E2000000000000000000000B", "E2000000000000000000000C"


def straight(count: int, step_m: float = 0.2) -> np.ndarray:
    """A drive along x."""
    return np.column_stack([step_m * np.arange(count), np.zeros(count), np.zeros(count)])


def passes_of(reads: dict[str, list[int]], poses: np.ndarray) -> list[Pass]:
    epcs = [epc for epc, indices in reads.items() for _ in indices]
    indices = [index for indices in reads.values() for index in indices]
    return find_passes(np.array(epcs), np.array(indices, np.int64), poses)


def test_the_cloud_of_the_docstring() -> None:
    [found] = passes_of({A: [41, 42, 44, 45, 47]}, straight(100))
    assert (found.epc, found.first, found.centre, found.last) == (A, 41, 44, 47)
    assert (found.x, found.y) == pytest.approx((8.8, 0.0))
    assert found.range_m == pytest.approx(0.6)


def test_the_centre_is_the_middle_of_the_index_range_not_of_the_reads() -> None:
    [found] = passes_of({A: [10, 11, 12, 13, 30]}, straight(100))
    assert found.centre == 20


def test_the_range_is_half_a_chord_where_the_drive_turned() -> None:
    angle = np.linspace(0, np.pi, 21)
    poses = np.column_stack([5 * np.sin(angle), 5 * (1 - np.cos(angle)), angle])
    [found] = passes_of({A: [0, 4, 12, 20]}, poses)
    assert found.range_m == pytest.approx(5.0)  # the way driven is 15.7 m
    assert (found.x, found.y) == pytest.approx((5.0, 5.0))


def test_a_single_read_is_a_pass() -> None:
    [found] = passes_of({A: [0]}, straight(3))
    assert (found.first, found.centre, found.last, found.range_m) == (0, 0, 0, 0.0)


def test_a_second_pass_of_one_tag_is_another_cloud() -> None:
    found = passes_of({A: [5, 10, 15, 60, 62]}, straight(100))
    assert [(p.first, p.centre, p.last) for p in found] == [(5, 10, 15), (60, 61, 62)]


def test_a_vehicle_that_stands_under_a_tag_makes_one_pass() -> None:
    poses = straight(300)
    poses[100:250, 0] = poses[100, 0]  # 15 s, silent for the most part
    poses[250:, 0] -= poses[250, 0] - poses[100, 0] - 0.2
    [found] = passes_of({A: [95, 104, 190, 248]}, poses)
    assert (found.first, found.last) == (95, 248)


def test_a_short_silence_at_speed_is_one_pass() -> None:
    [found] = passes_of({A: [10, 14, 18]}, straight(40, step_m=1.5))  # 6 m without a read, but only 0.4 s
    assert (found.first, found.last) == (10, 18)


@pytest.mark.parametrize(("gap", "step_m", "clouds"), [(15, 0.3, 1), (16, 0.3, 2), (16, 0.249, 1), (16, 0.26, 2)])
def test_a_cloud_ends_when_it_was_silent_for_both_ticks_and_metres(gap: int, step_m: float, clouds: int) -> None:
    assert len(passes_of({A: [10, 10 + gap]}, straight(100, step_m))) == clouds


def test_driving_back_and_forth_counts_as_way() -> None:
    out_and_back = np.concatenate([np.arange(0, 5, 0.1), np.arange(5, 0, -0.1)])  # ends where it began
    poses = np.column_stack([out_and_back, np.zeros((len(out_and_back), 2))])
    assert len(passes_of({A: [1, 98]}, poses)) == 2


def test_passes_come_in_driving_order_whatever_the_order_of_the_reads() -> None:
    reads = {B: [75, 70, 20, 25], A: [52, 50]}
    assert [(p.epc, p.centre) for p in passes_of(reads, straight(100))] == [(B, 22), (A, 51), (B, 72)]


def test_overlapping_clouds_are_both_kept_and_reported() -> None:
    found = passes_of({A: [10, 20], B: [18, 29, 40], C: [50, 60]}, straight(100))
    assert [p.epc for p in found] == [A, B, C]
    assert [(a.epc, b.epc) for a, b in overlapping_passes(found)] == [(A, B)]


def test_overlaps_are_found_among_passes_that_are_no_neighbours() -> None:
    wide = [*range(0, 101, 10)]
    found = passes_of({A: wide, B: [55, 56], C: [90, 91]}, straight(120))
    assert [(a.epc, b.epc) for a, b in overlapping_passes(found)] == [(A, B), (A, C)]


@pytest.mark.parametrize("middle", [0, 1, 50, 98, 99])
def test_tags_on_one_bolt_are_passed_at_poses_of_their_own(middle: int) -> None:
    found = passes_of({C: [middle], A: [middle], B: [middle]}, straight(100))
    assert [p.epc for p in found] == [A, B, C]
    centres = np.array([p.centre for p in found])
    assert np.all(np.diff(centres) == 1)
    assert np.all(np.abs(centres - middle) <= 2)
    assert centres[0] >= 0
    assert centres[-1] <= 99
    assert [p.x for p in found] == pytest.approx((0.2 * centres).tolist())


def test_passes_that_crowd_push_no_more_than_they_must() -> None:
    found = passes_of({A: [10], B: [10], C: [11]}, straight(100))
    assert [p.centre for p in found] == [10, 11, 12]
    assert [p.first for p in found] == [10, 10, 11]  # the reads stay where they were


def test_no_reads_no_passes() -> None:
    assert find_passes(np.array([], np.str_), np.array([], np.int64), straight(5)) == []


def test_a_few_reads_from_elsewhere_are_thin_at_any_speed() -> None:
    """Three reads far down the drift, beside a pass at a walk, one at full speed and one with a stop under the tag."""
    walk, fast = straight(200, 0.1), straight(200, 1.0)
    stop = straight(200, 0.2)
    stop[50:120, 0] = stop[50, 0]
    slow = passes_of({A: [*range(40, 80)], B: [*range(10, 30)]}, walk)
    quick = passes_of({A: [100, 101, 102, 103, 150, 151]}, fast)
    stood = passes_of({A: [*range(40, 131)]}, stop)
    thin = thin_passes([slow, quick, stood], [200] * 3)
    assert [[(found.epc, found.first) for found in of] for of in thin] == [[], [(A, 150)], []]


def test_a_tag_that_was_read_once_is_never_thin() -> None:
    assert thin_passes([passes_of({A: [45], B: [50, 51, 52]}, straight(100))], [100]) == [[]]


def test_a_cloud_that_a_run_begins_or_ends_in_is_cut_off_not_thin() -> None:
    whole, cut = passes_of({A: [*range(40, 80)]}, straight(200)), passes_of({A: [*range(12)]}, straight(200))
    assert thin_passes([whole, cut], [200, 200]) == [[], []]
    late = passes_of({A: [*range(60, 72)]}, straight(200))
    assert thin_passes([whole, late], [200, 200]) == [[], late]
