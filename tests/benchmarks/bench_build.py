"""Build an hour of one recording (36,000 ticks, 541 beams): time against real time, with one job and two, and memory.

All in: starting Python, reading, mapping, writing. What is held against real time is the CPU time of the one process,
which is its wall time on a machine that does nothing else. One job and two take turns, and the medians are compared:
virtual machines change their speed by the minute. The hour is simulated at the first run and kept in the temporary
folder.
"""

import sys
import tempfile
from pathlib import Path
from statistics import median

from building import build, network, same_atlas
from table import Figure, report

from rtlog_client.log_file import read_info
from rtlog_server.topics import TICK

BLOCKS = 6  # 6.7 km of drifts
TICK_S = 0.1
TURNS = 3
LEAST_RATE, LEAST_GAIN = 100.0, 1.7


def main() -> int:
    recordings = network(BLOCKS, one_run=True)
    seconds = TICK_S * sum(read_info(path).message_counts[TICK.name] for path in recordings)
    one, two, same = [], [], True
    with tempfile.TemporaryDirectory() as folder:
        for k in range(TURNS):
            one_atlas, two_atlas = Path(folder) / f"{k}-one.atlas", Path(folder) / f"{k}-two.atlas"
            one.append(build(recordings, one_atlas))
            two.append(build(recordings, two_atlas, "--jobs", "2"))
            same &= same_atlas(one_atlas, two_atlas)
    one_wall_s, two_wall_s = (median(build.wall_s for build in builds) for builds in (one, two))
    one_cpu_s, two_cpu_s = (median(build.cpu_s for build in builds) for builds in (one, two))
    return report(
        f"a build of {seconds:.0f} s of driving",
        [
            Figure("one job: wall", one_wall_s, "s"),
            Figure("one job: CPU", one_cpu_s, "s"),
            Figure("one job: times faster than real time, by the clock", seconds / one_wall_s),
            Figure("one job: times faster than real time, by CPU time", seconds / one_cpu_s, "", least=LEAST_RATE),
            Figure("one job: peak memory", max(build.peak_mb for build in one), "MB"),
            Figure("two jobs: wall", two_wall_s, "s"),
            Figure("two jobs: CPU", two_cpu_s, "s"),
            Figure("two jobs: times faster than one", one_wall_s / two_wall_s, "", least=LEAST_GAIN),
            Figure("two jobs: the same atlas, byte for byte", float(same), "", least=1.0),
        ],
    )


if __name__ == "__main__":
    sys.exit(main())
