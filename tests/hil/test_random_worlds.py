"""Random worlds, drawn by number, of five topologies, mapped and held against the law of
`tests/benchmarks/random_worlds.py`. Each of these numbers has once broken the mapper.
"""

import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[1] / "benchmarks" / "random_worlds.py"


@pytest.mark.timeout(1800)
@pytest.mark.parametrize("number", [6, 10, 11, 22, 26, 28])
def test_a_random_world_is_mapped_within_the_law(number: int) -> None:
    found = subprocess.run([sys.executable, SCRIPT, str(number)], capture_output=True, text=True, check=False)
    assert found.returncode == 0, found.stdout + found.stderr
