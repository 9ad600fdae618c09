"""More than a million inputs, as a hostile wire or a broken encoder sends them, break no law of the SEI protocol."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

RUNS = 550_000  # for each of the two ways in
FUZZER = Path(__file__).with_name("fuzz_sei.py")


@pytest.mark.parametrize("way", ["answer", "request"])
@pytest.mark.timeout(1800)
def test_no_input_breaks_the_law(way: str, tmp_path: Path) -> None:
    pytest.importorskip("atheris", reason="atheris has no build for this Python")
    command = [sys.executable, str(FUZZER), way, str(RUNS), str(tmp_path)]
    result = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path)
    assert result.returncode == 0, result.stderr[-3000:]
    assert int(re.search(r"number_of_executed_units: (\d+)", result.stderr)[1]) >= RUNS
