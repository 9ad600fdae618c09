"""A soak: all at full rate for 20 minutes, a fault every few seconds; nothing grows, nothing goes missing untold.

Two scanners at 50 Hz, two encoders, a reader. `--soak-s 60` is a short one. It prints its figures.
"""

import random
import signal
import threading
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest

EVERY_S = 4.0  # a fault begins
SETTLE_S = 30.0  # of a process's start are not looked at: caches fill
GROWTH_MB_PER_H = 10.0  # at most, of each process's resident memory; noise of a minute is more
NOISE_MB = 3.0
DEVICES = ("laser/primary", "encoders", "rfid", "laser/auxiliary")
KINDS = {
    "drop": "for_s = 0.4",
    "delay": "for_s = 1.0\nby_s = 0.2",
    "cut": "for_s = 1.2",
    "restart": "for_s = 0.8",
    "garble": "for_s = 0.5\nshare = 0.05",
    "swap": 'for_s = 1.0\nother = "laser/auxiliary"',
}
PAGE = 4096
TICK_NS = 100_000_000


def script(seconds: float) -> str:
    """A fault every few seconds, of a kind and a device by lot."""
    lot = random.Random(5)
    faults = []
    for at_s in np.arange(EVERY_S, seconds - EVERY_S, EVERY_S):
        kind = lot.choice(list(KINDS))
        device = "laser/primary" if kind == "swap" else lot.choice(DEVICES)
        faults.append(f'[[fault]]\ndevice = "{device}"\nkind = "{kind}"\nat_s = {at_s}\n{KINDS[kind]}\n')
    return "".join(faults)


class MemoryWatch(threading.Thread):
    """Resident memory of processes, in MB, once a second."""

    def __init__(self, pids: dict[str, int]) -> None:
        super().__init__(daemon=True)
        self.rows: dict[str, list[tuple[float, float]]] = {name: [] for name in pids}
        self.cpu_s: dict[str, float] = {}
        self._pids = pids
        self._stopping = threading.Event()

    def run(self) -> None:
        while not self._stopping.wait(1.0):
            for name, pid in self._pids.items():
                pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
                self.rows[name].append((time.monotonic(), pages * PAGE / 1e6))
                fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
                self.cpu_s[name] = (int(fields[11]) + int(fields[12])) / 100

    def stop(self) -> None:
        self._stopping.set()
        self.join()

    def slope_mb_per_h(self, name: str) -> tuple[float, float, float]:
        """Slope of the second half and more, the memory at its start and at its end."""
        rows = np.array(self.rows[name])
        rows = rows[rows[:, 0] > rows[0, 0] + min(SETTLE_S, len(rows) / 3)]
        slope = np.polyfit(rows[:, 0] - rows[0, 0], rows[:, 1], 1)[0] * 3600
        return float(slope), float(rows[0, 1]), float(rows[-1, 1])


@pytest.mark.timeout(3600)
def test_soak(make_rig: Any, make_drive: Any, two_lasers: Any, request: pytest.FixtureRequest, capsys: Any) -> None:
    seconds = request.config.getoption("--soak-s")
    rig = make_rig(auxiliary=True)
    recording = make_drive(seconds, 50, two_lasers)
    faults = script(seconds)
    with ExitStack() as stack:
        server, recorder = stack.enter_context(rig.running())
        replay = stack.enter_context(rig.replay(recording, faults))
        pids = {"sampling": server.popen.pid, "publishing": server.child(), "recorder": recorder.popen.pid}
        watch = MemoryWatch(pids)
        watch.start()
        report = replay.finish(timeout_s=seconds + 120)
        watch.stop()
        recorder.popen.send_signal(signal.SIGINT)
        summary = recorder.finish(timeout_s=60)
        server.popen.terminate()
        server.finish(timeout_s=60)
    played = rig.compare(recording, report, summary, "".join(server.lines))
    with capsys.disabled():
        print(f"\n{figures(played, watch, seconds)}")
    assert played.comparison["missing_ticks"] == 0
    assert played.comparison["overruns"] <= stood_whole_ticks(played)
    assert played.summary["lost"] == {}
    assert played.unexplained() == []
    for name in watch.rows:
        slope, first, last = watch.slope_mb_per_h(name)
        assert slope < GROWTH_MB_PER_H or last - first < NOISE_MB, name
    for device in played.comparison["devices"]:
        accounted = device["same"] + device["superseded"] + len(device["differences"])
        assert accounted >= device["went_in"], device["device"]


def stood_whole_ticks(played: Any) -> int:
    """In how many ticks nothing on this machine ran, not even at real-time priority, as a virtual machine may be."""
    stalls = (stall["to_ns"] - stall["from_ns"] for stall in played.report["stalls"])
    return sum(stall // TICK_NS + 1 for stall in stalls if stall > TICK_NS)


def figures(played: Any, watch: MemoryWatch, seconds: float) -> str:
    comparison = played.comparison
    stalls_ms = [(stall["to_ns"] - stall["from_ns"]) * 1e-6 for stall in played.report["stalls"]]
    lines = [
        f"{seconds:g} s, {len(played.report['faults'])} faults",
        f"the machine stood still {len(stalls_ms)} times, {max(stalls_ms, default=0.0):.0f} ms at most",
        f"{comparison['ticks']} ticks, {comparison['missing_ticks']} missing, {comparison['overruns']} a period late",
    ]
    for device in comparison["devices"]:
        counts = dict.fromkeys(("lost", "late", "changed", "extra", "stamp", "turns", "silent"), 0)
        for difference in device["differences"]:
            counts[difference["what"]] += 1
        told = ", ".join(f"{count} {what}" for what, count in counts.items() if count)
        unexplained = sum(not difference["cause"] for difference in device["differences"])
        lines.append(
            f"{device['device']}: {device['went_in']} in, {device['same']} same, {device['superseded']} superseded,"
            f" {told or 'none else'}; {unexplained} unexplained"
        )
        by_stall = sum("stood still" in difference["cause"] for difference in device["differences"])
        lines.append(f"  of these because the machine stood still: {by_stall}")
        p99 = device["figures"].get("stamp_error_ms_p99")
        if p99 is not None:
            lines.append(f"  stamps off by {p99} ms at p99, {device['figures']['stamp_error_ms_max']} ms at most")
    for name in watch.rows:
        slope, first, last = watch.slope_mb_per_h(name)
        cpu = watch.cpu_s[name] / max(len(watch.rows[name]), 1)
        lines.append(f"{name}: {first:.1f} → {last:.1f} MB, {slope:+.2f} MB/h, {100 * cpu:.1f} % of a core")
    return "\n".join(lines)
