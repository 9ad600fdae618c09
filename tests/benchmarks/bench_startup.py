"""How soon rtlog-atlas answers: its help, and a small build once the kernels are compiled.

Of the build the CPU time counts, which is what it takes on a machine that does nothing else.
"""

import subprocess
import sys
import tempfile
import time
from pathlib import Path

from building import build
from table import Figure, report

from processing.simulation.simulate import simulate

ROUNDS = 5
MOST_HELP_S, MOST_START_S = 0.3, 2.0
SMALL = """
schema = 1
name = "short"
profile = "canmet_trailer"
drifts = [{ points = [[0, 0], [40, 0]], width_m = 4.5, roughness_m = 0.2 }]
runs = [{ name = "out", waypoints = [[8, 0], [14, 0]], speed_m_s = 2.0 }]
"""


def help_s() -> float:
    began = time.monotonic()
    subprocess.run([sys.executable, "-m", "processing.cli", "--help"], check=True, capture_output=True)
    return time.monotonic() - began


def main() -> int:
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "short.toml").write_text(SMALL)
        (run,) = simulate(Path(folder) / "short.toml", Path(folder) / "short")
        build([run.path], Path(folder) / "first.atlas")
        builds = [build([run.path], Path(folder) / f"{k}.atlas") for k in range(ROUNDS)]
    return report(
        "starting up",
        [
            Figure("rtlog-atlas --help", min(help_s() for _ in range(ROUNDS)), "s", most=MOST_HELP_S),
            Figure(f"a second build, of {run.ticks} ticks: wall", min(of.wall_s for of in builds), "s"),
            Figure(
                f"a second build, of {run.ticks} ticks: CPU", min(of.cpu_s for of in builds), "s", most=MOST_START_S
            ),
        ],
    )


if __name__ == "__main__":
    sys.exit(main())
