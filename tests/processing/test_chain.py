"""Two witnesses on simulated drives with hazards: who is convicted, told where, and what the drive comes to."""

from pathlib import Path

import numpy as np
import pytest

from processing.convictions import convictions
from processing.geometry import relative
from processing.pipeline import DrivenRun, drive_through
from processing.read_log import begin_reading
from processing.ready_runs import make_ready
from processing.scan_matching import match_scans
from processing.simulation.simulate import simulate
from processing.tum import read_tum
from processing.workers import Workers

WORLD = """
schema = 1
name = "bend"
seed = 3
profile = "canmet_trailer"
walls.roughness_m = {roughness_m}
drifts = [{{ points = [[0, 0], [40, 0], [60, 20], [60, 50]], width_m = 4.6 }}]
runs = [{{ name = "out", waypoints = [[6, 0], [40, 0], [60, 20], [60, 44]], speed_m_s = 2.0 }}]
hazards = [{hazard}]
"""


def drive(folder: Path, hazard: str = "", roughness_m: float = 0.2) -> tuple[DrivenRun, np.ndarray]:
    """The run, open loop, and the true pose (n, 3) of every scan."""
    (folder / "bend.toml").write_text(WORLD.format(hazard=hazard, roughness_m=roughness_m), encoding="utf-8")
    simulate(folder / "bend.toml", folder / "bend")
    runs = begin_reading([folder / "bend" / "bend-out.mcap"], None, folder, Workers(1))()
    driven = drive_through(make_ready(runs, with_tags=False, work=Workers(1)), Workers(1), match_scans)[0]
    stamps, true = read_tum(folder / "bend" / "bend-out.tum")
    return driven, true[np.searchsorted(stamps, driven.run.scans.stamps_ns)]


def end_error(driven: DrivenRun, true: np.ndarray) -> np.ndarray:
    poses = driven.loop.poses
    return relative(relative(true[0], true[-1]), relative(poses[0], poses[-1]))


HAZARDS = [
    '{ kind = "slip", at_s = 12.0, factor = 1.6 }',
    '{ kind = "slip", at_s = 12.0, factor = 0.4 }',
    '{ kind = "slide", at_s = 12.0 }',
    '{ kind = "spin", at_s = 12.0, extra_m_s = 1.5 }',
    '{ kind = "stuck", at_s = 12.0, for_s = 10.0 }',
    '{ kind = "reset", at_s = 12.0 }',
    '{ kind = "jump", at_s = 12.0, turns = 0.8 }',
]


@pytest.mark.parametrize("hazard", HAZARDS)
def test_wheels_that_lie_are_convicted_where_the_walls_are_rough(tmp_path: Path, hazard: str) -> None:
    driven, true = drive(tmp_path, hazard)
    assert np.hypot(*end_error(driven, true)[:2]) < 0.1  # of 70 m, open loop
    told = convictions(driven)
    assert told
    assert {of["what"] for of in told} == {"wheels"}
    assert min(of["ticks"][0] for of in told) == pytest.approx(120, abs=5)
    assert max(of["ticks"][1] for of in told) < 230


@pytest.mark.parametrize("kind", ["odometry_missing", "stuck"])
def test_odometry_that_ends_or_freezes_leaves_the_rest_to_the_walls(tmp_path: Path, kind: str) -> None:
    driven, true = drive(tmp_path, f'{{ kind = "{kind}", at_s = 12.0, for_s = 600.0 }}')
    assert np.hypot(*end_error(driven, true)[:2]) < 0.15
    wheels = [of["ticks"] for of in convictions(driven) if of["what"] == "wheels"]
    assert wheels[0][0] == pytest.approx(120, abs=5)
    assert wheels[-1][1] > driven.run.scan_ticks[-1] - 60  # by then the vehicle stands, as the wheels say


def test_nobody_is_convicted_of_an_honest_drive(tmp_path: Path) -> None:
    driven, true = drive(tmp_path)
    assert convictions(driven) == []
    assert np.hypot(*end_error(driven, true)[:2]) < 0.1
    assert driven.loop.odometry.guessed is None


def test_between_smooth_walls_a_slip_does_not_turn_the_drive(tmp_path: Path) -> None:
    driven, true = drive(tmp_path, '{ kind = "slip", at_s = 8.0, factor = 1.6 }', roughness_m=0.0)
    heading = relative(true[0], true[130])[2] - relative(driven.loop.poses[0], driven.loop.poses[130])[2]
    assert abs(np.degrees(heading)) < 0.5  # the wheels alone are 40° off


def test_a_vehicle_that_drives_ahead_between_smooth_walls_holds_nobody_back(tmp_path: Path) -> None:
    hazard = '{ kind = "traffic", way = "along", at_s = 4.0, for_s = 12.0, gap_m = 5.0, aside_m = 0.0 }'
    driven, true = drive(tmp_path, hazard, roughness_m=0.0)
    there, found = (relative(poses[0], poses[170])[0] for poses in (true, driven.loop.poses))
    assert abs(found - there) < 0.03 * there


def test_a_scanner_that_is_silent_round_a_corner_loses_nothing(tmp_path: Path) -> None:
    """The encoders went on: their way is no arc from the last scan to the next."""
    driven, true = drive(tmp_path, '{ kind = "scans_missing", at_s = 17.0, for_s = 4.0 }')
    pause = int(np.argmax(np.diff(driven.run.scans.times)))
    moved, counted = relative(true[pause], true[pause + 1]), driven.loop.odometry.deltas[pause]
    assert abs(moved[2]) > 0.3
    assert np.hypot(*(moved - counted)[:2]) < 0.15
    assert np.hypot(*end_error(driven, true)[:2]) < 0.2


def test_an_engine_that_makes_a_parked_vehicle_tremble_convicts_nobody(tmp_path: Path) -> None:
    """A tenth of a degree that no wheel counts makes no key frame either."""
    from processing.chain import Chain

    driven, _ = drive(tmp_path)
    sweeps = driven.loop.sweeps
    here = sweeps.scan(100)
    chain = Chain(60, sweeps.mount, match_scans)
    chain.add_keyframe(0, here)
    rng = np.random.default_rng(2)
    for k in range(1, 60):
        c, s = np.cos(turn := rng.normal(0, np.radians(0.1))), np.sin(turn)
        points = sweeps.points(slice(100, 101))[0] @ np.array([[c, -s], [s, c]])
        trembling = type(here)(
            points.astype(float),
            here.normals @ np.array([[c, -s], [s, c]]),
            here.variances,
            here.angle_min,
            here.angle_increment,
            here.bent_rad + 0.01,
            here.mount,
        )
        assert chain.advance(k, trembling, np.zeros(3), np.diag([1e-8, 1e-8, 4e-10]), 0.1)
        assert not chain.wants_keyframe
    assert chain.contradictions == []
