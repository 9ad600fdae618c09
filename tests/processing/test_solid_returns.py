"""What hangs alone before the walls goes, and nothing else."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_array_equal

from processing.solid_returns import solid_returns

BEAMS = 181
ANGLES = np.radians(np.linspace(-90, 90, BEAMS))
NOISE_M = 0.012


def solid(ranges: np.ndarray) -> np.ndarray:
    return solid_returns(np.column_stack([ranges * np.cos(ANGLES), ranges * np.sin(ANGLES)]), NOISE_M)


def wall(rough_m: float = 0.1) -> np.ndarray:
    """3 m all around."""
    return 3.0 + rough_m * np.sin(40 * ANGLES) + np.random.default_rng(1).normal(0, NOISE_M, BEAMS)


@pytest.mark.parametrize("width", [1, 2, 3])
def test_what_is_narrow_and_near_is_left_out(width: int) -> None:
    for first in (0, 1, 90, BEAMS - width):
        ranges = wall()
        ranges[first : first + width] = 1.5
        assert_array_equal(solid(ranges), np.delete(np.arange(BEAMS), np.arange(first, first + width)))


def test_what_is_wide_enough_to_be_a_wall_stays() -> None:
    ranges = wall()
    ranges[50:54] = 1.5
    assert len(solid(ranges)) == BEAMS


def test_what_lies_behind_a_gap_stays() -> None:
    """A narrow view through a crack, or past a corner, stands out from nothing."""
    ranges = wall()
    ranges[[20, 40, 41]] = 8.0
    assert len(solid(ranges)) == BEAMS


def test_layers_of_grains_go_one_after_the_other() -> None:
    ranges = wall(rough_m=0.0)
    ranges[60:66] = [2.6, 2.2, 1.8, 1.4, 1.0, 2.0]  # each hides behind the next
    assert_array_equal(solid(ranges), np.delete(np.arange(BEAMS), np.arange(60, 66)))


@given(st.integers(0, 1000), st.floats(0.05, 0.6))
def test_in_dust_the_wall_stays_and_few_grains_do(seed: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    smooth = wall(rough_m=0.0)
    grains = rng.random(BEAMS) < share
    kept = solid(np.where(grains, rng.uniform(0.3, 2.8, BEAMS), smooth))
    assert (~grains)[kept].sum() >= (~grains).sum() - 1
    assert grains[kept].sum() <= 0.1 * BEAMS


@given(st.lists(st.sampled_from([np.nan, 1.0, 2.0, 5.0]), min_size=BEAMS, max_size=BEAMS))
def test_only_returns_are_kept_and_none_twice(ranges: list[float]) -> None:
    kept = solid(np.array(ranges))
    assert np.all(np.diff(kept) > 0)
    assert np.all(np.isfinite(np.array(ranges)[kept]))
