"""Stamps that scatter about an even pace are put back onto it; other clocks are left alone."""

import numpy as np
import pytest

from processing.even_clocks import even_times


@pytest.mark.parametrize("missing", [0.0, 0.02, 0.1])
@pytest.mark.parametrize("pace_s", [0.04, 0.1])
def test_scatter_of_a_fifth_of_the_pace_goes(missing: float, pace_s: float) -> None:
    rng = np.random.default_rng(2)
    beats = np.flatnonzero(rng.random(3000) >= missing)
    true = 5.0 + beats * pace_s * 1.0001  # the sender's clock is no better than others
    stamps = np.sort(true + rng.normal(0, 0.2 * pace_s, len(true)))
    even = even_times(stamps)
    assert even is not None
    assert np.all(np.diff(even) > 0)
    assert np.std(even - true) < 0.3 * np.std(stamps - true)


def test_a_clock_that_keeps_its_pace_is_left_alone() -> None:
    assert even_times(0.1 * np.arange(500) + np.random.default_rng(1).normal(0, 0.0005, 500)) is None


def test_samples_without_a_pace_are_left_alone() -> None:
    assert even_times(np.cumsum(np.random.default_rng(1).uniform(0.02, 0.6, 500))) is None
    assert even_times(np.arange(10) * 0.1) is None
