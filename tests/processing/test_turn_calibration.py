"""Turns: errors of track, wheels and steering zero are found from what matches see, and taken out of the wheels."""

import msgspec
import numpy as np
import pytest

from hw_profiles.profile import load_profile
from processing.calibration import compare_strides, cut_strides, join_pairs, pairs_of
from processing.odometry import wheel_steps
from processing.pipeline import DrivenRun
from processing.turn_calibration import PRIOR_BIAS_PER_M, PRIOR_SCALE, WheelTurn, fit_turn, put_right
from processing.wheel_turns import turn_of


def test_scale_and_bias_are_found_among_slip_and_matches_that_jumped() -> None:
    rng = np.random.default_rng(8)
    seen, ahead_m = rng.normal(0, 0.2, 600), rng.choice([-2.0, 2.0, 4.0], 600)
    counted = (seen + 0.012 * ahead_m) / 1.03 + rng.normal(0, 0.04, 600)
    seen[::6] += rng.choice([-0.5, 0.3], 100)
    found = fit_turn(counted, ahead_m, seen, np.full(600, 1e-6))
    errors = np.array([found.scale - 1.03, found.bias_per_m + 0.012])
    assert np.all(np.abs(errors) < 3 * np.sqrt(np.diag(found.covariance)))
    assert np.all(np.sqrt(np.diag(found.covariance)) < [0.02, 0.002])


def test_nothing_seen_changes_nothing_and_says_so() -> None:
    found = fit_turn(np.zeros(0), np.zeros(0), np.zeros(0), np.zeros(0))
    assert (found.scale, found.bias_per_m) == (1.0, 0.0)
    assert np.sqrt(np.diag(found.covariance)) == pytest.approx([PRIOR_SCALE, PRIOR_BIAS_PER_M])


@pytest.mark.parametrize("name", ["canmet_trailer", "cu_ss534"])
def test_wheels_put_right_count_the_true_way_and_turn(name: str) -> None:
    rng, profile = np.random.default_rng(9), load_profile(name)
    wheels = np.column_stack([np.cumsum(rng.uniform(0, 0.5, 50)), np.cumsum(rng.uniform(0, 0.5, 50))])
    if name == "cu_ss534":
        wheels[:, 1] = np.radians(2) * rng.standard_normal(50)  # of the steering
    distances, turns = wheel_steps(profile, *wheels.T)
    turn = WheelTurn(1.02, 0.01, np.eye(2))
    other, changed = put_right(profile, wheels, 0.985, turn)
    true_distances, true_turns = wheel_steps(other, *changed.T)
    assert true_turns == pytest.approx(1.02 * turns + 0.01 * distances, abs=2e-5)
    bent = 0.0 if name == "cu_ss534" else turn.bias_per_m * msgspec.structs.asdict(other.vehicle)["track_width_m"] / 4
    half_track = (profile.vehicle.track_width_m or 0.0) / 2 if profile.vehicle else 0.0
    assert true_distances == pytest.approx(0.985 * distances + 2 * bent * half_track * turns, abs=1e-6)


def test_a_calibrated_run_turns_as_its_matches_see_it(driven: list[DrivenRun]) -> None:
    for of in driven:  # its world has wheels of unequal radius: 1.2 mrad a metre
        left = turn_of(pairs_of(of.run, join_pairs([compare_strides(strides) for strides in cut_strides(of.run)])))
        sigmas = np.sqrt(np.diag(left.covariance))
        assert abs(left.bias_per_m) < max(3 * sigmas[1], 1e-4)
        assert abs(left.scale - 1) < max(3 * sigmas[0], 1e-3)
        assert sigmas[1] < 6e-4
