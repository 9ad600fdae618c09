"""Skids in odometry known by hand: what comes back is filled in, what does not is believed."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from processing.odometry import Motions
from processing.skids import has_pace, without_skids

COUNT, PACE_S = 200, 0.1


def rolling(speed_m_s: float = 2.0, turn_rad_s: float = 0.1) -> np.ndarray:
    return np.tile([speed_m_s * PACE_S, 0.0, turn_rad_s * PACE_S], (COUNT, 1))


def mend(deltas: np.ndarray, seconds: np.ndarray | None = None) -> Motions:
    covariances = np.tile(1e-6 * np.eye(3), (len(deltas), 1, 1))
    return without_skids(Motions(deltas, covariances), np.full(len(deltas), PACE_S) if seconds is None else seconds)


def test_a_drive_without_skids_is_the_same() -> None:
    deltas = rolling()
    deltas[:, 0] *= np.linspace(0.0, 1.0, COUNT)  # gathers speed, as vehicles do
    assert mend(deltas).guessed is None


def test_a_vehicle_that_stands_has_none() -> None:
    assert mend(np.zeros((COUNT, 3))).guessed is None


@pytest.mark.parametrize("extra_m_s", [-2.0, 1.5])
def test_wheels_that_lock_or_spin_for_a_second_are_filled_in(extra_m_s: float) -> None:
    deltas = rolling()
    deltas[80:90, 0] += extra_m_s * PACE_S
    mended = mend(deltas)
    assert mended.guessed is not None
    assert np.flatnonzero(mended.guessed).tolist() == list(range(80, 90))
    assert_allclose(mended.deltas, rolling(), atol=1e-9)
    assert np.all(mended.covariances[80:90, 0, 0] > 1e-3)
    assert_allclose(mended.covariances[:80], np.tile(1e-6 * np.eye(3), (80, 1, 1)))


def test_a_stop_that_lasts_is_believed_however_sudden() -> None:
    deltas = rolling()
    deltas[80:] = 0.0
    assert mend(deltas).guessed is None


def test_braking_and_going_on_is_no_skid() -> None:
    deltas = rolling()
    deltas[80:120, 0] *= np.abs(np.linspace(-1, 1, 40))  # 2 m/s to nothing and back within 4 s
    assert mend(deltas).guessed is None


def test_a_count_that_starts_anew_is_filled_in_at_any_pace() -> None:
    uneven = np.random.default_rng(1).uniform(0.2, 2.0, COUNT)
    deltas = rolling() / PACE_S * uneven[:, None]
    deltas[50] = [-70.0, 3.0, 2.0]
    mended = mend(deltas, uneven)
    assert mended.guessed is not None
    assert np.flatnonzero(mended.guessed).tolist() == [50]
    assert_allclose(mended.deltas[50], [2.0 * uneven[50], 0.0, 0.1 * uneven[50]], atol=1e-9)


def test_stamps_that_jitter_are_no_skids() -> None:
    jitter = np.random.default_rng(1).normal(0, 0.015, COUNT)
    deltas = rolling() * (1 + jitter[:, None] / PACE_S)
    assert mend(deltas).guessed is None


def test_a_pace_is_quick_and_even() -> None:
    assert has_pace(np.full(50, 0.1))
    assert not has_pace(np.full(50, 1.0))
    assert not has_pace(np.random.default_rng(1).uniform(0.01, 0.3, 50))
    assert not has_pace(np.zeros(0))


def test_an_odometry_of_which_no_step_is_possible_tells_nothing() -> None:
    """As one in millimetres: the walls must say all."""
    mended = mend(1000 * rolling())
    assert mended.guessed is not None
    assert mended.guessed.all()
    assert_allclose(mended.deltas, 0)
    assert np.all(mended.covariances[:, 0, 0] > 1e-3)
    none = mend(np.zeros((0, 3)), np.zeros(0))
    assert len(none.deltas) == 0
