"""More than a million inputs for each protocol, as a hostile wire or a broken device sends them, break no law of it."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

RUNS = {
    ("alien", "console"): 350_000,
    ("alien", "lines"): 350_000,
    ("alien", "reader"): 350_000,
    ("cia406", "frames"): 750_000,
    ("cia406", "answers"): 160_000,
    ("cia406", "slcan"): 100_000,
    ("lms111", "stream-A"): 300_000,
    ("lms111", "stream-B"): 300_000,
    ("lms111", "payload-A"): 300_000,
    ("lms111", "payload-B"): 300_000,
    ("sei", "answer"): 550_000,
    ("sei", "request"): 550_000,
}


@pytest.mark.parametrize(("protocol", "way"), RUNS)
@pytest.mark.timeout(1800)
def test_no_input_breaks_the_law(protocol: str, way: str, tmp_path: Path) -> None:
    pytest.importorskip("atheris", reason="atheris has no build for this Python")
    fuzzer, runs = Path(__file__).with_name(f"fuzz_{protocol}.py"), RUNS[protocol, way]
    command = [sys.executable, str(fuzzer), way, str(runs), str(tmp_path)]
    result = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path)
    assert result.returncode == 0, result.stderr[-3000:]
    executed = int(re.search(r"number_of_executed_units: (\d+)", result.stderr)[1])
    print(f"{protocol}, {way}: {executed} inputs")
    assert executed >= runs
