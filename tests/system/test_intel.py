"""A real building: the Intel Research Lab, from the log to Kümmerle's metric, by the commands that a user has."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from processing.map_files import read_map

DATA = Path(__file__).parents[3] / "shared" / "data" / "carmen"


def atlas_command(*arguments: object) -> str:
    command = [sys.executable, "-m", "processing.cli", *map(str, arguments)]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


@pytest.mark.skipif(not DATA.exists(), reason=f"the Intel log is not at {DATA}")
@pytest.mark.timeout(600)
def test_intel_lab(tmp_path: Path) -> None:
    atlas_command("import", "carmen", DATA / "intel-merged-raw.log.gz", "-o", tmp_path / "intel.mcap")
    atlas_command("build", tmp_path / "intel.mcap", "-o", tmp_path / "intel.atlas", "--method", "global")
    told = atlas_command("compare", tmp_path / "intel.atlas", "--relations", DATA / "intel.relations", "--json")
    errors = json.loads(told)["relations"]
    assert errors["relations"] == 2984
    assert errors["translation_mean_m"] < 0.07  # wheels alone: 7.39 m
    assert errors["rotation_mean_deg"] < 1.5  # wheels alone: 39.5°
    points = read_map(tmp_path / "intel.atlas").occupied_points()
    width, height = points.max(axis=0) - points.min(axis=0)
    assert 26 < min(width, height) <= max(width, height) < 45  # the building is some 30 m square
