"""Errors against the truth: none for a truth that was only moved, and the known figure for each known disturbance."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from processing.evaluation import (
    Beacon,
    Matched,
    Trajectory,
    absolute_error,
    align_parts,
    align_whole,
    beacon_errors,
    distribution,
    edge_length_errors,
    largest_part_share,
    match_truth,
    relative_error,
    true_place,
    way_driven,
)
from processing.geometry import accumulate, compose, inverse, transform

MOVE = np.array([12.0, -7.0, 2.5])


def drive(turn_per_step: float = 0.0) -> np.ndarray:
    """A winding drive of 300 steps of 1 m."""
    motions = np.column_stack([np.ones(300), np.zeros(300), 0.05 * np.sin(np.arange(300) / 9)])
    return accumulate(np.zeros(3), motions + np.array([0, 0, turn_per_step]))


def figures(runs: dict[str, Matched], parts: dict[str, int]):
    return absolute_error(runs, parts, align_parts(runs, parts))


def test_moved_truth_has_no_error() -> None:
    runs = {
        "a": Matched(compose(MOVE, drive()), drive(), 3),
        "b": Matched(compose(MOVE, drive()[:50]), drive()[:50], 1),
    }
    error = figures(runs, {"a": 0, "b": 0})
    assert_allclose([error.rmse_m, error.max_m, error.heading_rmse_deg], 0, atol=1e-9)
    assert (error.stamps, error.uncounted) == (351, 4)
    for distance_m in (10, 100):
        drift = relative_error(runs, distance_m)
        assert_allclose([drift.translation_rmse_m, drift.rotation_rmse_deg], 0, atol=1e-9)


def test_parts_move_apart_but_a_whole_does_not() -> None:
    runs = {"a": Matched(compose(MOVE, drive()), drive(), 0), "b": Matched(drive(), drive(), 0)}
    assert_allclose(figures(runs, {"a": 0, "b": 1}).rmse_m, 0, atol=1e-9)
    assert figures(runs, {"a": 0, "b": 0}).rmse_m > 5
    parts = {"a": 0, "b": 1}
    assert absolute_error(runs, parts, align_whole(runs, parts)) == figures(runs, {"a": 0, "b": 0})


def test_the_largest_part_holds_its_share_of_the_way_driven() -> None:
    ways_m = {"a": way_driven(drive()), "b": way_driven(drive()[:101]), "c": way_driven(drive()[:101])}
    assert_allclose(list(ways_m.values()), [300, 100, 100])
    assert_allclose(largest_part_share(ways_m, {"a": 0, "b": 1, "c": 1}), 0.6)
    assert_allclose(largest_part_share(ways_m, {"a": 0, "b": 1, "c": 0}), 0.8)
    assert largest_part_share({"a": 0.0}, {"a": 0}) == 1.0  # it stood still


def test_known_disturbance_of_positions() -> None:
    x = np.arange(400) * 0.5
    truth = np.column_stack([x, np.zeros(400), np.zeros(400)])
    zigzag = truth + np.column_stack([np.zeros(400), np.tile([0.1, -0.1, -0.1, 0.1], 100), np.full(400, 0.01)])
    error = figures({"a": Matched(zigzag, truth, 0)}, {"a": 0})
    assert_allclose([error.rmse_m, error.max_m], 0.1, rtol=1e-3)
    assert_allclose(error.heading_rmse_deg, np.degrees(0.01), rtol=1e-3)


def test_known_drift_of_motion() -> None:
    straight = np.column_stack([np.arange(301.0), np.zeros((301, 2))])
    stretched = relative_error({"a": Matched(straight * [1.01, 1, 1], straight, 0)}, 10)
    turned = relative_error({"a": Matched(drive(turn_per_step=0.001), drive(), 0)}, 10)
    assert_allclose(stretched.translation_rmse_m, 0.1, rtol=1e-6)
    assert (stretched.distance_m, stretched.pairs) == (10, 291)
    assert_allclose(turned.rotation_rmse_deg, np.degrees(0.01), rtol=1e-6)
    assert relative_error({"a": Matched(straight[:50], straight[:50], 0)}, 100) is None


def test_standing_still_weighs_nothing() -> None:
    truth = np.column_stack([np.arange(101.0), np.zeros((101, 2))])
    estimate = truth * [1.01, 1, 1]
    waited = [np.repeat(poses, np.where(np.arange(101) == 30, 5000, 1), axis=0) for poses in (estimate, truth)]
    plain = relative_error({"a": Matched(estimate, truth, 0)}, 10)
    assert relative_error({"a": Matched(*waited, 0)}, 10) == plain


def test_truth_is_interpolated_and_never_extrapolated() -> None:
    truth = Trajectory(np.array([0, 1000, 3000]), np.array([[0, 0, 3.0], [1, 0, -3.0], [3, 4, -3.0]]))
    stamps = np.array([-1, 0, 500, 2000, 3000, 3001])
    matched = match_truth(Trajectory(stamps, np.arange(18.0).reshape(6, 3)), truth)
    assert matched.uncounted == 2
    assert_allclose(matched.truth[:, :2], [[0, 0], [0.5, 0], [2, 2], [3, 4]])
    assert_allclose(np.cos(matched.truth[1, 2]), -1)  # halfway from 3 to -3 the shorter way is π, not 0
    assert_allclose(matched.estimate[:, 0], [3, 6, 9, 12])


@pytest.fixture
def beacons() -> tuple[list[Beacon], dict[str, Matched]]:
    estimate = compose(MOVE, drive())
    places = [estimate[20, :2], estimate[200, :2] + [0.3, 0.0]]
    at = [Beacon(f"E{k}", place, 0, ["a"]) for k, place in enumerate(places)]
    return [*at, Beacon("E9", np.zeros(2), 0, ["unknown run"])], {"a": Matched(estimate, drive(), 0)}


def test_beacons_of_a_moved_truth(beacons) -> None:
    nodes, runs = beacons
    moves = align_parts(runs, {"a": 0})
    places = np.array([true_place(node, runs) for node in nodes])
    assert_allclose(places[0], drive()[20, :2], atol=1e-9)
    errors = beacon_errors(nodes, places, moves, {"E0": drive()[20, :2] + [3.0, 4.0]})
    assert [error.epc for error in errors] == ["E0", "E1"]
    assert_allclose([error.error_m for error in errors], 0, atol=1e-9)
    assert_allclose(errors[0].to_tag_m, 5.0)
    assert errors[1].to_tag_m is None
    assert_allclose(edge_length_errors(nodes, places, [(0, 1), (0, 2)]), [0.0], atol=1e-9)


def test_beacons_and_edges_of_a_stretched_map(beacons) -> None:
    nodes, runs = beacons
    places = np.array([true_place(node, runs) for node in nodes])
    centre = runs["a"].truth[:, :2].mean(axis=0)
    stretched = transform(MOVE, centre + 1.02 * (transform(inverse(MOVE), nodes[0].position) - centre))
    moved = [Beacon("E0", stretched, 0, ["a"]), nodes[1]]
    errors = beacon_errors(moved, places[:2], align_parts(runs, {"a": 0}), {})
    assert_allclose(errors[0].error_m, 0.02 * np.linalg.norm(places[0] - centre))
    true_length = np.linalg.norm(places[1] - places[0])
    longer = np.linalg.norm(nodes[1].position - stretched) - true_length
    assert_allclose(edge_length_errors(moved, places[:2], [(0, 1)]), [longer])
    assert longer > 0.5


def test_distribution() -> None:
    spread = distribution(np.array([3.0, -4.0]))
    assert (spread.count, spread.max) == (2, 4.0)
    assert_allclose(spread.rmse, np.sqrt(12.5))
    assert distribution(np.zeros(0)) is None
