"""Stamps that go back and forth are brought into the order of the recording; sound ones stay as they are."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from recorded_drive import START_NS

from processing.stamps import rising_stamps


@pytest.mark.parametrize("seed", range(5))
def test_stamps_rise_whatever_the_clock_does(seed: int) -> None:
    rng = np.random.default_rng(seed)
    stamps = START_NS + np.cumsum(rng.integers(-40_000_000, 100_000_000, 500)).astype(np.int64)
    stamps[rng.integers(0, 500, 30)] = stamps[rng.integers(0, 500)]
    rising = rising_stamps(stamps)
    assert np.all(np.diff(rising) > 0)
    assert rising.dtype == np.int64


def test_sound_stamps_are_taken_at_their_word() -> None:
    rng = np.random.default_rng(1)
    stamps = START_NS + np.cumsum(rng.integers(1, 90_000_000, 300)).astype(np.int64)
    assert_array_equal(rising_stamps(stamps), stamps)
    wrong = rng.choice(300, 30, replace=False)  # also the first, the last and neighbours
    wrong[:3] = [0, 299, wrong[4] + 1]
    ran_away = stamps.copy()
    ran_away[wrong] += rng.choice([-1, 1], 30) * 3_600_000_000_000  # an hour, either way
    sound = np.setdiff1d(np.arange(300), wrong)
    assert_array_equal(rising_stamps(ran_away)[sound], stamps[sound])


def test_stamps_in_doubt_keep_the_pace() -> None:
    even = START_NS + 100_000_000 * np.arange(20)
    wrong = even.copy()
    wrong[[0, 7, 8, 18, 19]] = START_NS + np.array([9_000_000_000, 0, 0, 1, 0])
    assert_array_equal(rising_stamps(wrong), even)
    assert_array_equal(rising_stamps(even[:1]), even[:1])
