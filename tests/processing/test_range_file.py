"""Ranges in a scratch file: what was written comes back, whatever rows are asked for."""

import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from hw_profiles.errors import RTLogError
from processing.range_file import RangeFile, Ranges

ROWS = np.random.default_rng(1).uniform(0, 20, (12, 30)).astype(np.float32)


def write(path: Path, lengths: list[int], is_mirrored: bool = False) -> Ranges:
    file = RangeFile(path)
    for row, length in zip(ROWS, lengths, strict=True):
        file.append(row[:length])
    ranges = file.finish()
    file.close()
    return ranges.mirrored() if is_mirrored else ranges


@pytest.mark.parametrize("is_mirrored", [False, True])
def test_rows_come_back_by_any_index(tmp_path: Path, is_mirrored: bool) -> None:
    ranges = write(tmp_path / "a", [30] * 12, is_mirrored)
    expected = ROWS[:, ::-1] if is_mirrored else ROWS
    assert ranges.shape == (12, 30)
    for which in (slice(None), slice(3, 7), slice(5, 5), np.array([2, 3, 4, 9, 1]), np.array([], np.int64), 6, -1):
        assert_array_equal(ranges[which], expected[which])
    with pytest.raises(IndexError):
        ranges[12]


@pytest.mark.parametrize("is_mirrored", [False, True])
def test_beams_that_are_left_out_come_back_as_nothing(tmp_path: Path, is_mirrored: bool) -> None:
    ranges = replace(write(tmp_path / "a", [30] * 12, is_mirrored), left_out=((0, 2), (7, 11)))
    expected = (ROWS[:, ::-1] if is_mirrored else ROWS).copy()
    expected[:, [0, 1, 7, 8, 9, 10]] = np.nan
    assert_array_equal(ranges[:], expected)
    assert_array_equal(ranges[3], expected[3])
    assert_array_equal(ranges.cut(4, 6)[np.array([2, 0])], expected[[6, 4]])


def test_short_scans_are_padded_before_and_after_a_longer_one(tmp_path: Path) -> None:
    lengths = [20, 20, 30, 25, 30, 20, 30, 30, 30, 30, 30, 10]
    found = write(tmp_path / "a", lengths)[:]
    for row, all_of_it, length in zip(found, ROWS, lengths, strict=True):
        assert_array_equal(row[:length], all_of_it[:length])
        assert np.isnan(row[length:]).all()


def test_a_cut_of_it_is_small_and_finds_its_rows(tmp_path: Path) -> None:
    cut = pickle.loads(pickle.dumps(write(tmp_path / "a", [30] * 12).cut(2, 9).cut(1, 4)))
    assert len(pickle.dumps(cut)) < 500
    assert_array_equal(cut[:], ROWS[3:7])
    assert_array_equal(cut[np.array([3, 0])], ROWS[[6, 3]])


def test_a_full_disk_is_told() -> None:
    file = RangeFile(Path("/dev/full"))
    file.append(ROWS[0, :20])
    with pytest.raises(RTLogError, match="TMPDIR"):
        file.append(ROWS[1])  # longer, so what is there is written anew
    with pytest.raises(RTLogError, match="TMPDIR"):
        file.finish()
    with pytest.raises(RTLogError, match="TMPDIR"):
        file.close()


def test_a_file_that_was_cut_short_gives_no_made_up_rows(tmp_path: Path) -> None:
    ranges = write(tmp_path / "a", [30] * 12)
    with (tmp_path / "a").open("r+b") as file:
        file.truncate(4 * 30 * 11 + 7)
    assert_array_equal(ranges[:11], ROWS[:11])
    with pytest.raises(RTLogError, match="cut short"):
        ranges[10:]


def test_a_file_that_is_lost_or_cut_short_is_told(tmp_path: Path) -> None:
    ranges = write(tmp_path / "a", [30] * 12)
    (tmp_path / "a").write_bytes((tmp_path / "a").read_bytes()[:-1])
    assert ranges[10].shape == (30,)
    with pytest.raises(RTLogError, match="a: was cut short while it was in use"):
        ranges[11]
    (tmp_path / "a").unlink()
    with pytest.raises(RTLogError, match="a: was lost while it was in use: No such file"):
        ranges[0]
    with pytest.raises(RTLogError, match="TMPDIR"):
        RangeFile(tmp_path / "gone" / "b")
