"""Random worlds, drawn by number, of five topologies, mapped and held against the law of
`tests/benchmarks/random_worlds.py`. Each of the calm ones has once broken the mapper; the others are struck by hazards.
"""

import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[1] / "benchmarks" / "random_worlds.py"


def is_within_the_law(number: int, hazards: int) -> None:
    command = [sys.executable, SCRIPT, str(number), "--hazards", str(hazards)]
    found = subprocess.run(command, capture_output=True, text=True, check=False)
    assert found.returncode == 0, found.stdout + found.stderr


@pytest.mark.timeout(1800)
@pytest.mark.parametrize("number", [6, 10, 11, 22, 26, 28])
def test_a_random_world_is_mapped_within_the_law(number: int) -> None:
    is_within_the_law(number, 0)


@pytest.mark.timeout(1800)
@pytest.mark.parametrize("number", [25, 30, 31, 35, 36, 37])
def test_a_random_world_with_two_hazards_is_mapped_within_the_law_or_told(number: int) -> None:
    is_within_the_law(number, 2)
