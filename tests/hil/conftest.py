"""Hardware in the loop: the rig of rig.py on emulated devices, or on real ones with --hw-profile FILE.

A test asks for `rig`, plays drives with faults through it and compares; or for `vehicle`, whose devices may be real.
"""

import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from rtlog_server.topics import AUXILIARY_SCAN, PRIMARY_SCAN

sys.path.insert(0, str(Path(__file__).parent))
from drives import Drive
from rig import Rig, write_profile

VEHICLE_S = 120.0  # what the tests of `vehicle` take at most


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--hw-profile", type=Path, metavar="FILE", help="run on the real devices of this profile")
    parser.addoption("--soak-s", type=float, default=1200.0, metavar="S", help="length of the soak; default: 20 min")


@pytest.fixture
def emulated(request: pytest.FixtureRequest) -> None:
    """Of tests that do to a device what cannot be done to a real one."""
    if request.config.getoption("--hw-profile") is not None:
        pytest.skip("on real devices nobody pulls cables or plays a known drive: this runs on emulators only")


@pytest.fixture
def rig(emulated: None, tmp_path: Path) -> Rig:
    return Rig(tmp_path, write_profile(tmp_path))


@pytest.fixture
def make_rig(emulated: None, tmp_path: Path) -> Any:
    return lambda **options: Rig(tmp_path, write_profile(tmp_path, **options))


@pytest.fixture
def make_drive(tmp_path: Path) -> Any:
    def make(seconds: float, scan_hz: int = 10, lasers: Any = (PRIMARY_SCAN,), gap: tuple[int, int] = (0, 0)) -> Path:
        path = tmp_path / "drive.mcap"
        Drive(seconds, scan_hz, lasers, gap).write(path)
        return path

    return make


@pytest.fixture(scope="module")
def vehicle(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    """A vehicle that stands there, its devices alive: those of --hw-profile, or emulated ones on a drive."""
    folder = tmp_path_factory.mktemp("vehicle")
    real = request.config.getoption("--hw-profile")
    if real is not None:
        yield Rig(folder, real)
        return
    rig = Rig(folder, write_profile(folder))
    Drive(VEHICLE_S, 50).write(folder / "drive.mcap")
    with rig.replay(folder / "drive.mcap", "") as replay:
        replay.wait_for("of drive")
        yield rig


@pytest.fixture
def two_lasers() -> tuple[Any, Any]:
    return PRIMARY_SCAN, AUXILIARY_SCAN


def pytest_report_header(config: pytest.Config) -> str:
    return f"hardware: {config.getoption('--hw-profile') or 'emulated'}; {os.cpu_count()} cores"
