"""Missed tags: passes of the small mine are taken away, and must be found again where they were."""

from dataclasses import replace

import numpy as np
import pytest

from processing.build import Config
from processing.edge_placement import Placement
from processing.graph import Graph
from processing.missed_tags import MappedRun, add_passes, find_missed
from processing.open_loop import mount_pose
from processing.pipeline import DrivenRun, map_network
from processing.scan_matching import match_scans
from processing.workers import Workers


def mapped(driven: DrivenRun, truth: np.ndarray, part: int = 0) -> MappedRun:
    loop = driven.loop
    return MappedRun(driven.passes, loop.keyframes, truth[loop.keyframes], loop.scans, part, mount_pose(driven.run))


def without(run: MappedRun, *numbers: int) -> MappedRun:
    return replace(run, passes=[found for k, found in enumerate(run.passes) if k not in numbers])


@pytest.fixture
def runs(driven: list[DrivenRun], truth: list[np.ndarray]) -> list[MappedRun]:
    return [mapped(of, true) for of, true in zip(driven, truth, strict=True)]


def test_what_was_read_was_not_missed(runs: list[MappedRun]) -> None:
    assert [len(run.passes) for run in runs] == [6, 3]
    assert find_missed(runs, match_scans) == [[], []]


@pytest.mark.parametrize("number", [1, 2])
def test_a_pass_without_a_read_is_found_where_it_was(runs: list[MappedRun], number: int) -> None:
    missed = find_missed([runs[0], without(runs[1], number)], match_scans)
    assert missed[0] == []
    [found] = missed[1]
    assert (found.epc, found.read, found.range_m) == (runs[1].passes[number].epc, False, 0.0)
    assert found.centre in runs[1].keyframes
    assert abs(found.centre - runs[1].passes[number].centre) < 10  # 3 m


def test_several_in_a_row_are_found_too_from_a_later_lap_of_the_same_run(runs: list[MappedRun]) -> None:
    missed = find_missed([without(runs[0], 0, 1)], match_scans)[0]
    assert [found.epc[-3:] for found in missed] == ["401", "402"]
    assert find_missed([without(runs[0], 0, 1, 4, 5)], match_scans) == [[]]  # nobody knows these tags


def test_parts_that_nothing_joins_are_not_compared(runs: list[MappedRun]) -> None:
    assert find_missed([runs[0], replace(without(runs[1], 1, 2), part=1)], match_scans) == [[], []]


def test_another_drift_near_by_is_not_the_same(runs: list[MappedRun]) -> None:
    """Poses say that the run drove by; its scans do not."""
    aside = runs[1].poses + np.array([0.0, 0.0, np.pi / 2])
    assert find_missed([runs[0], replace(without(runs[1], 1, 2), poses=aside)], match_scans) == [[], []]
    assert len(find_missed([runs[0], without(runs[1], 1, 2)], match_scans)[1]) == 2


def test_passes_stay_in_driving_order_and_apart(runs: list[MappedRun]) -> None:
    all_of_them = list(runs[1].passes)
    assert add_passes(all_of_them[:1] + all_of_them[2:], all_of_them[1:2]) == all_of_them
    assert add_passes(all_of_them, all_of_them[1:2]) == all_of_them


def test_a_missed_tag_splits_the_path_and_the_wall_stays_one(driven: list[DrivenRun]) -> None:
    def edges(runs: list[DrivenRun]) -> tuple[list[DrivenRun], Graph, Placement]:
        return map_network(runs, Workers(1), match_scans, Config())

    [_, second] = driven
    shy = replace(second, passes=[second.passes[0], second.passes[2]])  # 402, then 401 twice
    runs, graph, placed = edges([driven[0], shy])
    assert [found.read for found in runs[1].passes] == [True, False, True]
    paths = {(piece.i, piece.j): [span.run for span in piece.spans] for piece in graph.pieces if piece.j is not None}
    assert paths[0, 1] == [0, 0, 1]
    assert len(placed.pieces) == len(graph.pieces)
    assert [piece.solved.input.piece for piece in placed.pieces] == list(graph.pieces)
