"""NEES: three where the covariances are right, and the band that its mean may lie in by chance."""

import re
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from hw_profiles.errors import BadInputError
from processing.consistency import consistency, edge_error, edge_errors, mean_band
from processing.evaluation import truth_at
from processing.geometry import accumulate, compose, relative

COVARIANCE = np.array([[0.04, 0.01, 0.001], [0.01, 0.02, 0.0], [0.001, 0.0, 0.0004]])


def disturbed(rng: np.random.Generator, promised: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """An edge of five poses somewhere, its covariances along the axes of its frame, and the truth in another frame."""
    truth = accumulate(np.array([5.0, -3.0, 2.0]), np.tile([1.0, 0.1, 0.2], (4, 1)))
    seen = relative(truth[:1], truth)
    seen[1:] += rng.multivariate_normal(np.zeros(3), COVARIANCE, 4)
    turn = np.eye(3)
    turn[:2, :2] = [[np.cos(0.7), -np.sin(0.7)], [np.sin(0.7), np.cos(0.7)]]
    covariances = np.zeros((5, 3, 3))
    covariances[1:] = promised * turn @ COVARIANCE @ turn.T
    return compose(np.array([1.0, 2.0, 0.7]), seen), covariances, truth


@pytest.mark.parametrize(("promised", "within"), [(1.0, True), (4.0, False), (0.25, False)])
def test_mean_nees_tells_right_covariances_from_wrong_ones(promised: float, within: bool) -> None:
    rng = np.random.default_rng(3)
    errors = [edge_error("e", *disturbed(rng, promised)) for _ in range(200)]
    found = consistency([error for error in errors if error is not None])
    assert found is not None
    assert found.edges == 200
    assert (found.band[0] < found.mean_nees < found.band[1]) == within
    assert found.pose_mean_nees == pytest.approx(3 / promised, rel=0.15)


def test_band_is_that_of_chi_squared() -> None:
    squares = np.random.default_rng(4).chisquare(3, (20_000, 10)).mean(axis=1)
    low, high = mean_band(10)
    assert np.mean((squares > low) & (squares < high)) == pytest.approx(0.95, abs=0.01)


def test_an_edge_of_one_pose_says_nothing() -> None:
    assert edge_error("e", np.zeros((1, 3)), np.zeros((1, 3, 3)), np.ones((1, 3))) is None
    assert consistency([]) is None


def test_truth_is_read_between_its_stamps_the_shorter_way_round() -> None:
    at = truth_at(np.array([10, 20]) * 10**9, np.array([[0.0, 0, 3.1], [1, 2, -3.1]]), np.array([15 * 10**9]))
    assert_allclose(at[0, :2], [0.5, 1.0])
    assert abs(at[0, 2]) == pytest.approx(np.pi)


def test_edges_are_read_from_an_atlas_and_spurs_are_not(tmp_path: Path) -> None:
    poses, covariances, truth = disturbed(np.random.default_rng(5), 1.0)
    (tmp_path / "edges").mkdir()
    stamps_ns = np.arange(5) * 10**9
    both = {"poses": np.tile(poses, (2, 1)), "covariances": np.tile(covariances, (2, 1, 1))}
    for name in ("0-1", "0-spur"):
        np.savez(tmp_path / "edges" / f"{name}.npz", path_firsts=[0, 5, 10], stamps_ns=np.tile(stamps_ns, 2), **both)
    edges = [
        {"id": "0-1", "kind": "edge", "paths": [{"run": "known"}, {"run": "unknown"}]},
        {"id": "0-spur", "kind": "spur", "paths": [{"run": "known"}]},
        {"id": "1-2", "kind": "edge", "paths": [{"run": "unknown"}]},
    ]
    found = edge_errors(tmp_path, edges, {"known": (stamps_ns, truth)})
    expected = edge_error("0-1", poses, covariances, truth)
    assert expected is not None
    assert [(error.edge, error.nees) for error in found] == [("0-1", pytest.approx(expected.nees))]


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"", "damaged: No data left in file"),
        (b"PK\x03\x04 torn", "damaged: File is not a zip file"),
        (b"dear diary", "damaged: "),
    ],
)
def test_a_damaged_file_of_an_edge_is_named(content: bytes, reason: str, tmp_path: Path) -> None:
    (tmp_path / "edges").mkdir()
    file = tmp_path / "edges" / "0-1.npz"
    edges = [{"id": "0-1", "kind": "edge", "paths": [{"run": "known"}]}]
    assert edge_errors(tmp_path, edges, {"known": (np.arange(2), np.zeros((2, 3)))}) == []  # no file, nothing stated
    file.write_bytes(content)
    with pytest.raises(BadInputError, match=f"^{re.escape(f'{file}: {reason}')}"):
        edge_errors(tmp_path, edges, {"known": (np.arange(2), np.zeros((2, 3)))})
    np.savez(file, poses=np.zeros((2, 3)))
    with pytest.raises(BadInputError, match=r"0-1\.npz: path_firsts is not a file in the archive"):
        edge_errors(tmp_path, edges, {"known": (np.arange(2), np.zeros((2, 3)))})
