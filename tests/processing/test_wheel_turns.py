"""Track, wheelbase and steering zero that are wrong in a profile are put right and told; of a right one nothing is."""

from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from hw_profiles.profile import Profile, read_profile_text
from processing.calibration import calibrate, compare_strides, cut_strides, join_pairs, pairs_of
from processing.pipeline import DrivenRun
from processing.read_log import Run, read_log
from processing.sensor_calibration import LaserPairs, calibrate_sensor
from processing.simulation.simulate import simulate
from processing.wheel_turns import TurnFit, calibrate_turns, tell_turns, turn_of

WORLD = """
schema = 1
name = "bends"
seed = 3
profile = "{profile}"
walls.roughness_m = 0.2
drifts = [{{ points = [[0, 0], [30, 0], [36, 24], [64, 30], [70, 2]], width_m = 4.6 }}]
runs = [{{ name = "through", waypoints = [[6, 0], [30, 0], [36, 24], [64, 30], [70, 8]], speed_m_s = 2.0 }}]
"""


@pytest.fixture(scope="module", params=["rear", "front"])
def bends(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Run, LaserPairs]:
    """A tricycle's drive through bends, and its laser's motions between pairs of scans."""
    folder = tmp_path_factory.mktemp("bends")
    profile = read_profile_text("cu_ss534").replace("[vehicle]", f'[vehicle]\ndrive_axle = "{request.param}"')
    (folder / "tricycle.toml").write_text(profile, encoding="utf-8")
    (folder / "bends.toml").write_text(WORLD.format(profile=folder / "tricycle.toml"), encoding="utf-8")
    simulate(folder / "bends.toml", folder / "bends")
    run = read_log(Path(folder / "bends" / "bends-through.mcap"))
    return run, pairs_seen(run)


def pairs_seen(run: Run) -> LaserPairs:
    return join_pairs([compare_strides(strides) for strides in cut_strides(run)])


def with_vehicle(profile: Profile, **changed: float) -> Profile:
    return msgspec.structs.replace(profile, vehicle=msgspec.structs.replace(profile.vehicle, **changed))


def spoilt(run: Run, zero_deg: float, base: float, gear: float, radius: float = 1.0) -> Run:
    """As if steering zero, wheelbase, and the counts of steering and wheel were so far off in the profile."""
    assert run.wheels is not None
    wheels = run.wheels * np.array([1 / radius, gear]) + np.array([0.0, np.radians(zero_deg)])
    return replace(run, wheels=wheels, profile=with_vehicle(run.profile, wheelbase_m=1.65 * base))


def put_right(run: Run, pairs: LaserPairs) -> tuple[Run, list[str]]:
    turned, motions, found = calibrate_turns(run, pairs)
    ready, wheels = calibrate(turned, motions)
    return ready, tell_turns(run.profile, ready.profile, found, wheels.sigma)


@pytest.mark.parametrize(
    ("zero_deg", "base", "gear", "told"),
    [(5.0, 1.1, 1.05, 2), (-5.0, 0.9, 1.05, 2), (5.0, 1.0, 1.0, 1), (0.0, 1.1, 1.0, 1), (0.0, 1.0, 1.0, 0)],
)
def test_a_tricycles_wrong_profile_is_put_right_and_told(
    bends: tuple[Run, LaserPairs], zero_deg: float, base: float, gear: float, told: int
) -> None:
    run, lines = put_right(spoilt(bends[0], zero_deg, base, gear), bends[1])
    assert run.wheels is not None
    assert bends[0].wheels is not None
    assert run.profile.vehicle is not None
    assert run.profile.vehicle.wheelbase_m == pytest.approx(
        1.65 * gear, rel=0.01
    )  # what of the gear is wrong goes there
    zeros = run.wheels[:, 1] / gear - bends[0].wheels[:, 1]
    assert np.degrees(zeros) == pytest.approx(np.zeros(len(zeros)), abs=0.1)
    left = turn_of(pairs_of(run, bends[1]))
    assert abs(left.scale - 1) < 0.004
    assert abs(left.bias_per_m) < 4e-4
    assert len(lines) == told
    assert any(f"the steering's zero_deg of 0.00 is {zero_deg:.1f}" in line for line in lines) == (zero_deg != 0)


def test_a_wheel_that_is_worn_as_well_is_put_right_with_the_wheelbase(bends: tuple[Run, LaserPairs]) -> None:
    run, lines = put_right(spoilt(bends[0], 0.0, 1.1, 1.0, radius=1.03), bends[1])
    assert run.profile.vehicle is not None
    assert run.profile.vehicle.wheelbase_m == pytest.approx(1.65, rel=0.005)
    assert len(lines) == 1


def test_a_mount_that_is_off_bends_no_turns(bends: tuple[Run, LaserPairs]) -> None:
    sizes = []
    for x_m in (0.0, 0.15):
        lasers = bends[0].profile.lasers
        mount = msgspec.structs.replace(lasers.primary.mount, x_m=lasers.primary.mount.x_m + x_m)
        primary = msgspec.structs.replace(lasers.primary, mount=mount)
        profile = msgspec.structs.replace(bends[0].profile, lasers=msgspec.structs.replace(lasers, primary=primary))
        turned, _, _ = calibrate_turns(replace(bends[0], profile=profile), bends[1])
        assert turned.profile.lasers == profile.lasers
        sizes.append(msgspec.structs.asdict(turned.profile.vehicle)["wheelbase_m"])
    assert sizes[1] == pytest.approx(sizes[0], rel=0.001)


def test_a_zero_that_is_off_is_no_wrong_mount(bends: tuple[Run, LaserPairs]) -> None:
    assert calibrate_sensor(spoilt(bends[0], 5.0, 1.1, 1.05), bends[1])[1] == []


def test_a_wrong_track_is_put_right_and_told(driven: list[DrivenRun]) -> None:
    run = driven[0].run
    pairs = pairs_seen(run)
    track_m = msgspec.structs.asdict(run.profile.vehicle)["track_width_m"]
    for factor in (0.95, 1.0, 1.05):
        found, lines = put_right(replace(run, profile=with_vehicle(run.profile, track_width_m=factor * track_m)), pairs)
        assert msgspec.structs.asdict(found.profile.vehicle)["track_width_m"] == pytest.approx(track_m, rel=0.01)
        assert len(lines) == (factor != 1.0)
        assert all(f"track_width_m of {factor * track_m:.3f} is " in line for line in lines)


def test_a_right_wheel_that_grew_is_told(driven: list[DrivenRun]) -> None:
    run = driven[0].run
    assert run.wheels is not None
    lines = put_right(replace(run, wheels=run.wheels * np.array([1.0, 1 / 1.04])), pairs_seen(run))[1]
    assert len(lines) == 1
    assert "the right wheel's radius over the left's is" in lines[0]


def test_what_is_in_doubt_is_not_told(driven: list[DrivenRun]) -> None:
    profile = driven[0].run.profile
    track_m = msgspec.structs.asdict(profile.vehicle)["track_width_m"]
    other = with_vehicle(profile, track_width_m=1.05 * track_m)
    assert tell_turns(profile, other, TurnFit(0.002, 0.0, 0.01), 0.002)
    assert tell_turns(profile, other, TurnFit(0.02, 0.0, 0.01), 0.002) == []
    assert tell_turns(profile, other, TurnFit(0.002, 0.0, 0.01), 0.02) == []
    assert tell_turns(profile, profile, TurnFit(0.002, 0.03, 0.005), 0.002)
    assert tell_turns(profile, profile, TurnFit(0.002, 0.03, 0.02), 0.002) == []
