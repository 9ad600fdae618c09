"""Kümmerle's metric: nought for the truth, blind to where the map lies, and right on a published log."""

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from hw_profiles.errors import BadInputError
from processing.geometry import compose, relative
from processing.import_carmen import parse_lines
from processing.relations import Relations, read_relations, relation_errors

REAL = Path("../shared/data/carmen")


@pytest.fixture
def drive() -> tuple[np.ndarray, np.ndarray, Relations]:
    """200 poses at 10 Hz, and relations between some of them."""
    rng = np.random.default_rng(5)
    stamps = np.arange(200) * 100_000_000
    poses = np.column_stack([np.cumsum(rng.normal(0.1, 0.05, (200, 2)), axis=0), rng.uniform(-3, 3, 200)])
    start, end = rng.integers(0, 200, (2, 50))
    return stamps, poses, Relations(stamps[start], stamps[end], relative(poses[start], poses[end]))


def test_truth_has_no_error_wherever_it_lies_and_in_whatever_order(drive) -> None:
    stamps, poses, relations = drive
    moved = compose(np.array([5.0, -3.0, 2.0]), poses)
    shuffled = np.random.default_rng(6).permutation(len(stamps))
    errors = relation_errors(stamps[shuffled], moved[shuffled], relations, stamps, poses)
    assert_allclose([errors.translation_mean_m, errors.rotation_mean_deg], 0, atol=1e-9)
    assert errors.relations == 50


def test_known_error(drive) -> None:
    stamps, poses, relations = drive
    off = relations.poses + np.array([[0.3, 0.4, 0.0]] * 25 + [[0.0, 0.0, np.radians(-10)]] * 25)
    wrong = Relations(relations.start_ns, relations.end_ns, off)
    errors = relation_errors(stamps, poses, wrong, stamps, poses)
    assert_allclose([errors.translation_mean_m, errors.translation_std_m], 0.25, atol=1e-9)
    assert_allclose([errors.rotation_mean_deg, errors.rotation_std_deg], 5, atol=1e-9)


def test_sparse_estimates_are_carried_along_by_odometry(drive) -> None:
    stamps, poses, relations = drive
    odometry = compose(np.array([1.0, 2.0, -1.0]), poses)
    slow = Relations(2 * relations.start_ns, 2 * relations.end_ns, relations.poses)
    errors = relation_errors(2 * stamps[::10], poses[::10], slow, 2 * stamps, odometry)
    assert errors.carried > 50
    assert_allclose([errors.translation_mean_m, errors.rotation_mean_deg], 0, atol=1e-9)
    # an end no further than 0.1 s takes the estimate as it stands: here the wrong one, a tick beside it
    beside = relation_errors(stamps[1::2], poses[1::2], relations, stamps, odometry)
    assert beside.carried == 0
    assert beside.translation_mean_m > 0.01


def test_relations_of_another_recording_are_refused(drive) -> None:
    stamps, poses, relations = drive
    with pytest.raises(BadInputError, match="another recording"):
        relation_errors(stamps + 10**12, poses, relations, stamps + 10**12, poses)


def test_relations_file(tmp_path: Path) -> None:
    path = tmp_path / "a.relations"
    path.write_text("976052905.167303 976052911.885496 -0.05 -0.12 0.0 0.0 0.0 -1.68\n\n")
    relations = read_relations(path)
    assert (relations.start_ns[0], relations.end_ns[0]) == (976052905167303000, 976052911885496000)
    assert_allclose(relations.poses, [[-0.05, -0.12, -1.68]])
    for text, complaint in [("1 2 3", "line 1"), ("1 2 3 4 5 6 7 x", "line 1.*'x'"), ("", "no relation")]:
        path.write_text(text)
        with pytest.raises(BadInputError, match=complaint):
            read_relations(path)
    path.write_bytes(b"\xff\xfe")
    with pytest.raises(BadInputError, match="not a text"):
        read_relations(path)


@pytest.mark.skipif(not REAL.exists(), reason="the real logs in ../shared/data/carmen are not here")
def test_raw_odometry_of_intel() -> None:
    """The known figures are 7.39 ± 14.34 m and 39.5 ± 53.6°."""
    lines = list(parse_lines(REAL / "intel-merged-raw.log.gz", {}))
    stamps, poses = np.array([line.stamp_ns for line in lines]), np.array([line.odometry for line in lines])
    scans = np.array([line.ranges_m is not None for line in lines])
    errors = relation_errors(stamps[scans], poses[scans], read_relations(REAL / "intel.relations"), stamps, poses)
    assert errors.relations == 2984
    assert_allclose([errors.translation_mean_m, errors.translation_std_m], [7.39, 14.34], atol=0.005)
    assert_allclose([errors.rotation_mean_deg, errors.rotation_std_deg], [39.5, 53.6], atol=0.1)
