"""Drives and odd recordings that our simulator did not make: mapped as one, within what is asked of them.

They lie beside the repository, in ../shared; where they do not, these tests are skipped.
"""

import importlib.util
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from processing.build import Config, build
from processing.comparison import compare_truth
from processing.geometry import align, transform
from processing.simulation.simulate import simulate
from processing.tum import read_tum

SHARED = Path(__file__).parents[3] / "shared"
DRIVES, CASES = SHARED / "data" / "drives", SHARED / "cases" / "make_cases.py"

needs_drives = pytest.mark.skipif(not DRIVES.is_dir(), reason=f"{DRIVES} is not there: drives of another simulator")
needs_cases = pytest.mark.skipif(not CASES.is_file(), reason=f"{CASES} is not there: it makes odd recordings")


@needs_drives
@pytest.mark.parametrize(("name", "most_m"), [("slip", 0.03), ("level", 0.03), ("vehicles", 0.02), ("service", 0.5)])
def test_a_drive_of_another_simulator_is_one_map(tmp_path: Path, name: str, most_m: float) -> None:
    build(sorted((DRIVES / name).glob("*.mcap")), None, Config(), tmp_path / "found.atlas", jobs=2)
    found = compare_truth(tmp_path / "found.atlas", DRIVES / name)["truth"]
    assert found["parts"] == 1
    assert found["ate"]["rmse_m"] <= most_m


@pytest.fixture(scope="module")
def cases() -> ModuleType:
    spec = importlib.util.spec_from_file_location("make_cases", CASES)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@needs_cases
@pytest.mark.parametrize(
    ("case", "most_m", "witness"),
    [("plain", 0.01, None), ("reset", 0.02, "wheels"), ("odom_ends", 0.05, "wheels"), ("bucket", 0.03, None)],
)
def test_an_odd_odometry_or_view(
    cases: ModuleType, tmp_path: Path, case: str, most_m: float, witness: str | None
) -> None:
    cases.foreign(tmp_path / f"{case}.mcap", case)
    atlas = build([tmp_path / f"{case}.mcap"], None, Config(method="global"), tmp_path / "found.atlas")
    stamps_ns, poses = atlas.trajectories[case]
    true = cases.drive()
    k = np.round((stamps_ns - cases.START) * 1e-8).astype(int)
    assert rmse_m(poses[:, :2], true[k, :2]) <= most_m
    assert {of["what"] for of in atlas.document["convictions"]} == ({witness} if witness else set())
    if case == "bucket":
        assert any("the vehicle itself" in remark for remark in atlas.document["remarks"])


@needs_cases
@pytest.mark.parametrize(("case", "most_m"), [("stuck", 0.05), ("dropouts", 0.03)])
def test_a_loop_with_failing_senses(cases: ModuleType, tmp_path: Path, case: str, most_m: float) -> None:
    simulate("loop", tmp_path / "loop")
    getattr(cases, case)(tmp_path / "loop" / "loop-two_laps.mcap", tmp_path / f"{case}.mcap")
    build([tmp_path / f"{case}.mcap"], None, Config(), tmp_path / "found.atlas", jobs=2)
    stamps, found = read_tum(tmp_path / "found.atlas" / "trajectories" / f"{case}.tum")
    true_stamps, true = read_tum(tmp_path / "loop" / "loop-two_laps.tum")
    k = np.searchsorted(true_stamps, stamps).clip(max=len(true) - 1)
    same = true_stamps[k] == stamps
    assert same.mean() > 0.5
    assert rmse_m(found[same, :2], true[k[same], :2]) <= most_m


def rmse_m(found: np.ndarray, true: np.ndarray) -> float:
    move = align(found, true)
    return float(np.sqrt(np.mean(np.sum((transform(move, found) - true) ** 2, axis=1))))
