"""Build an hour of one recording (36,000 ticks, 541 beams): time against real time, with one job and two, and memory.

All in: starting Python, reading, mapping, writing. What is held against real time is the CPU time of the one process,
which is its wall time on a machine that does nothing else. The hour is simulated at the first run and kept in the
temporary folder.
"""

import sys
import tempfile
from pathlib import Path

from building import build, network, same_atlas
from table import Figure, report

from rtlog_client.log_file import read_info
from rtlog_server.topics import TICK

BLOCKS = 6  # 6.7 km of drifts
TICK_S = 0.1
LEAST_RATE, LEAST_GAIN = 100.0, 1.7


def main() -> int:
    recordings = network(BLOCKS, one_run=True)
    seconds = TICK_S * sum(read_info(path).message_counts[TICK.name] for path in recordings)
    with tempfile.TemporaryDirectory() as folder:
        one_atlas, two_atlas = Path(folder) / "one.atlas", Path(folder) / "two.atlas"
        one, two = build(recordings, one_atlas), build(recordings, two_atlas, "--jobs", "2")
        same = same_atlas(one_atlas, two_atlas)
    return report(
        f"a build of {seconds:.0f} s of driving",
        [
            Figure("one job: wall", one.wall_s, "s"),
            Figure("one job: CPU", one.cpu_s, "s"),
            Figure("one job: times faster than real time, by the clock", seconds / one.wall_s),
            Figure("one job: times faster than real time, by CPU time", seconds / one.cpu_s, "", least=LEAST_RATE),
            Figure("one job: peak memory", one.peak_mb, "MB"),
            Figure("two jobs: wall", two.wall_s, "s"),
            Figure("two jobs: CPU", two.cpu_s, "s"),
            Figure("two jobs: times faster than one", one.wall_s / two.wall_s, "", least=LEAST_GAIN),
            Figure("two jobs: the same atlas, byte for byte", float(same), "", least=1.0),
        ],
    )


if __name__ == "__main__":
    sys.exit(main())
