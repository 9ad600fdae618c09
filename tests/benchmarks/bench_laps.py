"""The same drifts again and again: laps of a loop of 280 m. What a lap costs must not grow too far with those before.

CPU time of the whole build, one job; the drives are simulated at the first run and kept in the temporary folder.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np
from building import WORLDS, build
from table import Figure, report

from processing.simulation.simulate import simulate
from processing.simulation.world import SHIPPED
from rtlog_client.log_file import read_info
from rtlog_server.topics import TICK

LAPS = (6, 12, 36)
WAYPOINTS = '"south", "se", "ne", "nw", "sw"'
TICK_S = 0.1
MOST_SLOPE = 1.5  # of log time against log laps


def drive(laps: int) -> Path:
    """The recording of so many laps at 3 m/s."""
    folder = WORLDS / f"laps{laps}"
    if not folder.exists():
        WORLDS.mkdir(exist_ok=True)
        text = (SHIPPED / "loop.toml").read_text()
        twice = f'[{WAYPOINTS}, {WAYPOINTS}, "south", [71, 0]]'
        assert twice in text
        text = text.replace(twice, f'[{", ".join([WAYPOINTS] * laps)}, "south", [71, 0]]')
        world = WORLDS / f"laps{laps}.toml"
        world.write_text(text.replace("speed_m_s = 2.0", "speed_m_s = 3.0"))
        simulate(str(world), folder)
    return next(folder.glob("*.mcap"))


def main() -> int:
    figures, seconds = [], []
    with tempfile.TemporaryDirectory() as folder:
        for laps in LAPS:
            recording = drive(laps)
            built = build([recording], Path(folder) / f"{laps}.atlas")
            driven_s = TICK_S * read_info(recording).message_counts[TICK.name]
            seconds.append(built.cpu_s)
            figures += [
                Figure(f"{laps} laps, {driven_s:.0f} s: CPU", built.cpu_s, "s"),
                Figure(f"{laps} laps: times faster than real time", driven_s / built.cpu_s),
                Figure(f"{laps} laps: peak memory", built.peak_mb, "MB"),
            ]
    slope = float(np.polyfit(np.log(LAPS), np.log(seconds), 1)[0])
    return report("laps", [*figures, Figure("slope of log time against log laps", slope, "", most=MOST_SLOPE)])


if __name__ == "__main__":
    sys.exit(main())
