"""How fast the vehicle is at each sweep: as its motions say, but never faster than vehicles are."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from processing.sweeps import velocities_of

TIMES = 0.1 * np.arange(21)
ROLLING = np.tile([0.2, 0.01, 0.03], (20, 1))


def test_a_motion_over_its_time_is_a_velocity() -> None:
    velocities = velocities_of(ROLLING, TIMES)
    assert_allclose(velocities, np.tile([2.0, 0.1, 0.3], (21, 1)))  # the last sweep as the one before


@pytest.mark.parametrize("jump", [[-70.0, 0.0, 0.0], [0.0, 3.0, 0.0], [0.2, 0.0, 2.5]])
def test_a_step_that_no_vehicle_makes_bends_no_sweep(jump: list[float]) -> None:
    for at in (slice(7, 8), slice(7, 12), slice(19, 20)):
        motions = ROLLING.copy()
        motions[at] = jump
        assert_allclose(velocities_of(motions, TIMES), velocities_of(ROLLING, TIMES))
    motions = ROLLING.copy()
    motions[:3] = jump
    assert_allclose(velocities_of(motions, TIMES)[:3], 0.0)  # nothing before it to go by
    assert_allclose(velocities_of(motions, TIMES)[3:], velocities_of(ROLLING, TIMES)[3:])


def test_times_squeezed_together_make_nobody_fast() -> None:
    times = TIMES.copy()
    times[10:15] = times[9] + 0.02 * np.arange(1, 6)  # 10 m/s
    assert np.abs(velocities_of(ROLLING, times)[:, 0]).max() <= 2 * 2.0 + 1e-9


def test_a_single_sweep_stands() -> None:
    assert_allclose(velocities_of(np.zeros((0, 3)), np.zeros(1)), np.zeros((1, 3)))
