"""What the server costs with the full suite (two scanners at 50 Hz, two encoders, a reader), and how soon it ticks.

The emulated devices run in a process of their own, and a zenoh client subscribes to everything. CPU and memory are
those of all processes of the server together. Memory is told twice: RSS counts pages that the processes share for each
of them, PSS once.
"""

import argparse
import os
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue

from emulated_vehicle import emulated_vehicle, running_server
from table import Figure, report

from rtlog_server.messages import decode, to_ns

MOST_CPU = 0.10  # of one core
MOST_RSS_MB = 120.0
MOST_START_S = 2.0
STARTS = 3
SETTLE_S = 4.0
PERIOD_NS = 100_000_000


@dataclass(frozen=True)
class Usage:
    cpu_s: float
    rss_mb: float
    pss_mb: float


def usage(process: int) -> Usage:
    """Of a process since its start; memory now."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    rollup = Path(f"/proc/{process}/smaps_rollup").read_text().splitlines()[1:]
    kb = {line.split(":")[0]: int(line.split()[1]) for line in rollup}
    return Usage((int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK"), kb["Rss"] / 1e3, kb["Pss"] / 1e3)


def processes(server: int) -> dict[str, int]:
    """Of the server, by what they do."""
    (publisher,) = Path(f"/proc/{server}/task/{server}/children").read_text().split()
    return {"sampling": server, "publishing": int(publisher)}


def start_s(profile: Path) -> float:
    """From the start of the process to its first tick."""
    ticks: SimpleQueue[bytes] = SimpleQueue()
    began_ns = time.time_ns()
    with running_server(profile) as (_, session):
        session.declare_subscriber("rtlog/full_suite/rtlog/tick", lambda sample: ticks.put(sample.payload.to_bytes()))
        tick = decode(ticks.get(timeout=30), "rtlog_msgs/msg/Tick")
    return (to_ns(tick.scheduled) - tick.index * PERIOD_NS - began_ns) * 1e-9


def measure(profile: Path, seconds: float) -> dict[str, float]:
    """Run the server on a profile for a while."""
    ticks: list[bytes] = []
    samples: list[str] = []
    with running_server(profile) as (server, session):
        session.declare_subscriber("rtlog/full_suite/rtlog/tick", lambda s: ticks.append(s.payload.to_bytes()))
        session.declare_subscriber("rtlog/full_suite/**", lambda s: samples.append(str(s.key_expr)))
        time.sleep(SETTLE_S)
        found = processes(server.pid)
        before = {name: usage(process) for name, process in found.items()}
        from_s, samples_before = time.monotonic(), len(samples)
        time.sleep(seconds)
        after = {name: usage(process) for name, process in found.items()}
        elapsed_s, samples_after = time.monotonic() - from_s, len(samples)
    tick = decode(ticks[-1], "rtlog_msgs/msg/Tick")
    states = {sensor.name: sensor.state for sensor in tick.sensors}
    if len(states) != 4 or any(states.values()):
        sys.exit(f"bench_server: not every device delivered: {states}")
    for name in found:
        cpu = (after[name].cpu_s - before[name].cpu_s) / elapsed_s
        print(f"  {name:10} {100 * cpu:5.1f} % CPU  {after[name].rss_mb:6.1f} MB RSS  {after[name].pss_mb:6.1f} MB PSS")
    return {
        "cpu": sum(after[name].cpu_s - before[name].cpu_s for name in found) / elapsed_s,
        "rss_mb": sum(one.rss_mb for one in after.values()),
        "pss_mb": sum(one.pss_mb for one in after.values()),
        "rate_hz": (samples_after - samples_before) / elapsed_s,
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=20.0, help="measured for so long (default 20)")
    seconds = parser.parse_args().seconds
    with tempfile.TemporaryDirectory() as folder, emulated_vehicle(Path(folder)) as profile:
        # what else the machine does at that moment can only make a start longer
        starts_s = [start_s(profile) for _ in range(STARTS)]
        figures = measure(profile, seconds)
    return report(
        f"full suite, {figures['rate_hz']:.0f} samples/s out, {seconds:.0f} s",
        [
            Figure("CPU of one core", 100 * figures["cpu"], "%", most=100 * MOST_CPU),
            Figure("memory, RSS", figures["rss_mb"], "MB", most=MOST_RSS_MB),
            Figure("memory, PSS", figures["pss_mb"], "MB"),
            Figure("first tick after", min(starts_s), "s", most=MOST_START_S),
        ],
    )


if __name__ == "__main__":
    sys.exit(main())
