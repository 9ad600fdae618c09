"""How late the server's ticks are beside cyclictest, at the same priority, in the same run, under load.

The server samples the full suite (emulated_vehicle.py); stress-ng keeps processors and disk busy. Both programs come
with Debian (apt-get install rt-tests stress-ng). Without stress-ng the load is our own; without cyclictest there is
nothing to compare with, and only missed ticks are judged.

    make bench                                     one minute
    tests/benchmarks/bench_ticks.py --minutes 10
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from emulated_vehicle import ask_status, emulated_vehicle, running_server
from numpy.typing import NDArray
from table import Figure, report

from rtlog_server.messages import decode
from rtlog_server.realtime import PRIORITY

TICK_MS = 100.0
CYCLE_US = 10_000  # cyclictest's period: shorter than a tick, for a p99.9 that is more than its worst value
LONGEST_US = 200_000  # of cyclictest's histogram
SETTLE_S = 4.0
MOST_RATIO, MOST_BEYOND_MS = 2.0, 0.2

OWN_LOAD = """
import os, sys, threading
while True:
    with open(sys.argv[1], "wb") as sink:
        for _ in range(64):
            sink.write(os.urandom(1 << 20))
            os.fsync(sink.fileno())
"""


@contextmanager
def load(folder: Path) -> Iterator[str]:
    """Busy processors and a busy disk as long as the context lasts; what makes them so."""
    cpus = 2 * (os.cpu_count() or 1)
    if shutil.which("stress-ng"):
        what = f"stress-ng --cpu {cpus} --io 1 --hdd 1"
        command = [*what.split(), "--hdd-bytes", "256M", "--temp-path", str(folder)]
        commands = [command]
    else:
        what = f"{cpus} processes that write random bytes to the disk (no stress-ng here)"
        commands = [[sys.executable, "-c", OWN_LOAD, str(folder / f"load{k}")] for k in range(cpus)]
    silent = subprocess.DEVNULL
    processes = [subprocess.Popen(command, stdout=silent, stderr=silent) for command in commands]
    try:
        yield what
    finally:
        for process in processes:
            process.terminate()
            process.wait()


@contextmanager
def cyclictest(folder: Path, seconds: float) -> Iterator[Path]:
    """cyclictest for so long, where there is one; where its histogram will be, if it may run."""
    result = folder / "cyclictest.json"
    if shutil.which("cyclictest") is None:
        yield result
        return
    command = ["cyclictest", "--mlockall", f"--priority={PRIORITY}", f"--interval={CYCLE_US}", "--default-system"]
    command += ["--quiet", f"--histogram={LONGEST_US}", f"--duration={seconds:.0f}", f"--json={result}"]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        yield result
        process.wait()


def read_histogram(path: Path) -> NDArray[np.float64]:
    """cyclictest's latencies in ms, ascending, one a sample (whole microseconds)."""
    (thread,) = json.loads(path.read_text())["thread"].values()
    counts = {int(us): count for us, count in thread["histogram"].items()}
    return np.repeat([us * 1e-3 for us in sorted(counts)], [counts[us] for us in sorted(counts)])


def measure(folder: Path, seconds: float) -> tuple[list[Any], dict[str, Any], NDArray[np.float64] | None, str]:
    """The Tick messages of the run, the server's status at its end, cyclictest's latencies, what the load was."""
    payloads: list[bytes] = []
    with emulated_vehicle(folder) as profile, running_server(profile) as (_, session), load(folder) as what:
        time.sleep(SETTLE_S)  # what a start takes is not judged
        session.declare_subscriber(
            "rtlog/full_suite/rtlog/tick", lambda sample: payloads.append(sample.payload.to_bytes())
        )
        with cyclictest(folder, seconds) as result:
            time.sleep(seconds)
        status = ask_status(session)
    ticks = [decode(payload, "rtlog_msgs/msg/Tick") for payload in payloads]
    return ticks, status, read_histogram(result) if result.exists() else None, what


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=1.0, help="measured for so long (default 1)")
    seconds = 60 * parser.parse_args().minutes
    with tempfile.TemporaryDirectory(dir="/var/tmp") as folder:  # /tmp may be memory, which is no disk
        ticks, status, theirs, what = measure(Path(folder), seconds)
    if not status["realtime"]["scheduler"].startswith(f"SCHED_FIFO {PRIORITY}"):
        print(f"not judged: {status['realtime']['scheduler']} (root, or the unit, is granted it)")
        return 0
    ours = np.array([tick.lateness for tick in ticks]) * 1e3
    print(f"{len(ticks)} ticks under {what}; {'; '.join(status['realtime'].values())}")
    print(f"{'ms':12} {'p50':>7} {'p99':>7} {'p99.9':>7} {'max':>7}")
    for name, lateness in (("rtlog-server", ours), ("cyclictest", theirs)):
        if lateness is not None:
            print(f"{name:12} " + " ".join(f"{q:7.3f}" for q in np.quantile(lateness, [0.5, 0.99, 0.999, 1.0])))
    indices = [tick.index for tick in ticks]
    missed = indices[-1] - indices[0] + 1 - len(indices) + int(np.count_nonzero(ours >= TICK_MS))
    figures = [Figure("missed ticks", missed, most=0)]
    if theirs is None:
        print("not compared: no cyclictest here (apt-get install rt-tests)")
    else:
        allowed_ms = MOST_RATIO * float(np.quantile(theirs, 0.999)) + MOST_BEYOND_MS
        figures.append(Figure("our p99", float(np.quantile(ours, 0.99)), "ms", most=allowed_ms))
    return report("rtlog-server beside cyclictest", figures)


if __name__ == "__main__":
    sys.exit(main())
