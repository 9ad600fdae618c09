"""More than a million inputs, as a hostile wire or a broken scanner sends them, break no law of the LMS111's parser."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

RUNS = 300_000  # for each of the four ways in
FUZZER = Path(__file__).with_name("fuzz_lms111.py")


@pytest.mark.parametrize("way", ["stream-A", "stream-B", "payload-A", "payload-B"])
@pytest.mark.timeout(900)
def test_no_input_breaks_the_law(way: str, tmp_path: Path) -> None:
    pytest.importorskip("atheris", reason="atheris has no build for this Python")
    command = [sys.executable, str(FUZZER), way, str(RUNS), str(tmp_path)]
    result = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path)
    assert result.returncode == 0, result.stderr[-3000:]
    executed = int(re.search(r"number_of_executed_units: (\d+)", result.stderr)[1])
    print(f"{way}: {executed} inputs")
    assert executed >= RUNS
