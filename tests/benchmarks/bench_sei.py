"""How close to the tick two encoders on an SEI bus are read, and how right the stamp is that both of them get.

Emulated encoders that answer at the pace of the wire, behind a pseudo-terminal, in a process of their own; both
processes in real time, where the system grants it. Asked is the moment at which the first of the two requests was
sent; a reading that came late is the next tick's.
"""

import argparse
import multiprocessing
import sys
import tempfile
import time
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Literal

import numpy as np

from hw_profiles.profile import Encoder, SeiBus
from rtlog_server.devices.device import TickGrid
from rtlog_server.devices.sei import protocol
from rtlog_server.devices.sei.driver import SeiEncoders
from rtlog_server.devices.sei.emulator import SeiBusEmulator
from rtlog_server.realtime import become_realtime

PERIOD_NS = 100_300_000  # no multiple of the 4 ms in which an encoder looks at its disc
COUNTS = 4096
TURNS_PER_S = 1.3
MOST_AGE_MS = 15.0
MOST_ERROR_MS = 5.0  # an encoder looks at its disc each 4 ms
ENCODERS = [
    Encoder(name="left_wheel", role="left_wheel", address=0, wheel_radius_m=0.35),
    Encoder(name="right_wheel", role="right_wheel", address=1, wheel_radius_m=0.35),
]
CASES: list[tuple[Literal[9600, 115200], Literal["single", "multi"], bool]] = [
    (9600, "single", False),
    (9600, "multi", False),
    (9600, "multi", True),
    (115200, "multi", False),
]


def counts_at(_address: int, at_ns: int) -> int:
    return int(at_ns * 1e-9 * TURNS_PER_S * COUNTS)


def emulate(link: Path, multi_turn: bool, strobe: bool, stopping: Event) -> None:
    become_realtime()
    with SeiBusEmulator(link, {0: COUNTS, 1: COUNTS}, counts_at, multi_turn=multi_turn, strobe=strobe):
        stopping.wait()


def measure(link: Path, bus: SeiBus, seconds: float) -> tuple[np.ndarray, np.ndarray, int]:
    """Ages of the first request and errors of each encoder's position at the stamp, in ms; and readings missed."""
    driver, grid = SeiEncoders("encoders", bus, ENCODERS), TickGrid(time.monotonic_ns(), PERIOD_NS)
    driver.start(grid)
    ages_ms, errors_ms, missed = [], [], 0
    settled_s, end_s = time.monotonic() + 4.0, time.monotonic() + 4.0 + seconds
    # From the mean of the latches to the first request: half a round of the wire, and the look at the disc before.
    wire_ns = protocol.wire_ns(1 + protocol.position_reply_bytes(bus.turns == "multi"), bus.baud)
    first_ns = 0 if bus.strobe else wire_ns // 2 - protocol.SNAPSHOT_NS // 2
    first_ns += protocol.wire_ns(1, bus.baud)
    while time.monotonic() < end_s:
        tick_ns = grid.next_after(time.monotonic_ns())
        time.sleep(max(0, tick_ns - time.monotonic_ns()) * 1e-9)
        samples = driver.collect(tick_ns).samples
        if time.monotonic() < settled_s:
            continue
        missed += not samples or (tick_ns - samples[-1].complete_ns) > PERIOD_NS // 2
        for reading in samples[-1:]:
            ages_ms.append((tick_ns - reading.measured_ns + first_ns) * 1e-6)
            for position_rad in reading.positions_rad:
                turns = position_rad / (2 * np.pi) - reading.measured_ns * 1e-9 * TURNS_PER_S
                errors_ms.append(((turns + 0.5) % 1 - 0.5) / TURNS_PER_S * 1e3)
    driver.close()
    return np.array(ages_ms), np.array(errors_ms), missed


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=12.0, help="for each case (default: %(default)s)")
    seconds = parser.parse_args().seconds
    print("; ".join(f"{key} {answer}" for key, answer in become_realtime().items()))
    print(f"{'bus':24}{'asked before the tick, ms':>28}{'stamp wrong by, ms':>22}{'late':>6}")
    print(f"{'':24}{'median':>14}{'p95':>7}{'worst':>7}{'median':>15}{'p95':>7}")
    well = True
    spawn = multiprocessing.get_context("spawn")
    for baud, turns, strobe in CASES:
        with tempfile.TemporaryDirectory() as folder:
            link, stopping = Path(folder) / "sei", spawn.Event()
            bus = SeiBus(port=str(link), baud=baud, turns=turns, strobe=strobe)
            emulator = spawn.Process(target=emulate, args=(link, turns == "multi", strobe, stopping))
            emulator.start()
            try:
                ages, errors, missed = measure(link, bus, seconds)
            finally:
                stopping.set()
                emulator.join()
        age, error = np.percentile(ages, [50, 95, 100]), np.percentile(np.abs(errors), 95)
        name = f"{baud} baud, {turns}{', strobe' if strobe else ''}"
        print(f"{name:24}{age[0]:14.1f}{age[1]:7.1f}{age[2]:7.1f}{np.median(errors):15.2f}{error:7.2f}{missed:6}")
        well = well and bool(age[0] <= MOST_AGE_MS and error <= MOST_ERROR_MS)
    target = f"asked at most {MOST_AGE_MS:.0f} ms before the tick (median), stamped within {MOST_ERROR_MS:.0f} ms (p95)"
    print(f"target: {target}: {'pass' if well else 'FAIL'}")
    return 0 if well else 1


if __name__ == "__main__":
    sys.exit(main())
