"""More than a million inputs, as a hostile bus or a broken adapter brings them, break no law of the CAN encoders."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

FUZZER = Path(__file__).with_name("fuzz_cia406.py")


@pytest.mark.parametrize(("way", "runs"), [("frames", 750_000), ("answers", 160_000), ("slcan", 100_000)])
@pytest.mark.timeout(1800)
def test_no_input_breaks_the_law(way: str, runs: int, tmp_path: Path) -> None:
    pytest.importorskip("atheris", reason="atheris has no build for this Python")
    command = [sys.executable, str(FUZZER), way, str(runs), str(tmp_path)]
    result = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path)
    assert result.returncode == 0, result.stderr[-3000:]
    assert int(re.search(r"number_of_executed_units: (\d+)", result.stderr)[1]) >= runs
