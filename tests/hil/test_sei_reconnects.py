"""The encoders' driver for longer: a thousand times the bus is lost in every way, at both baud rates.

What each test measured is printed (pytest -s, or -rP).
"""

import resource
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from hw_profiles.profile import Encoder, SeiBus
from rtlog_server.devices.device import TickGrid
from rtlog_server.devices.sei.driver import SeiEncoders
from rtlog_server.devices.sei.emulator import SeiBusEmulator

RECONNECTS = 1000  # half of them at each baud rate
BACK_S = 2.0
DEADLINE_S = 15.0
ENCODERS = [
    Encoder(name="left_wheel", role="left_wheel", address=0, wheel_radius_m=0.35),
    Encoder(name="right_wheel", role="right_wheel", address=1, wheel_radius_m=0.35),
]


def lose(emulator: SeiBusEmulator, number: int) -> None:
    """Mostly the adapter is pulled; sometimes all encoders fall silent, or lose their power, after garbage or not."""
    if number % 3 == 0:
        emulator.babble([b"\xff" * 50, b"\x10\x02"][number % 2])
    if number % 20 == 0:
        for encoder in ENCODERS:
            emulator.mute(encoder.address or 0)
        time.sleep(2.0)
        for encoder in ENCODERS:
            emulator.power_cycle(encoder.address or 0)
            emulator.mute(encoder.address or 0, muted=False)
    else:
        emulator.unplug()
        time.sleep(0.02 * (number % 5))
        emulator.replug()


def in_use() -> tuple[int, int]:
    """Descriptors and threads of this process."""
    return len(list(Path("/proc/self/fd").iterdir())), threading.active_count()


def wait_for_both(driver: SeiEncoders, connects: int) -> None:
    """Until both encoders are read over a connection newer than `connects`."""
    deadline = time.monotonic() + DEADLINE_S
    names: tuple[str, ...] = ()
    while driver.connects <= connects or len(names) < len(ENCODERS):
        assert time.monotonic() < deadline, driver.message
        time.sleep(0.002)
        samples = driver.collect(time.monotonic_ns()).samples
        names = samples[-1].names if samples and driver.connects > connects else names


@pytest.mark.timeout(1800)
@pytest.mark.parametrize("baud", [9600, 115200])
def test_a_thousand_reconnects(baud: int, tmp_path: Path) -> None:
    """Half of them at each baud rate: back within two seconds each time, and nothing left behind."""
    back_s, memory_kb = [], 0
    bus = SeiBus(port=str(tmp_path / "sei"), baud=baud)  # type: ignore[arg-type]
    counts = {encoder.address or 0: encoder.counts_per_turn for encoder in ENCODERS}
    with SeiBusEmulator(tmp_path / "sei", counts, lambda address, at_ns: at_ns // 1_000_000 + address) as emulator:
        driver = SeiEncoders("encoders", bus, ENCODERS)
        driver.start(TickGrid(time.monotonic_ns(), 100_000_000))
        wait_for_both(driver, 0)
        before = in_use()
        for number in range(RECONNECTS // 2):
            connects = driver.connects
            lose(emulator, number)
            returned = time.monotonic()
            wait_for_both(driver, connects)
            back_s.append(time.monotonic() - returned)
            if number == 100:
                memory_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        grown_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - memory_kb
        assert in_use() == before
        driver.close()
    print(
        f"{baud} baud: {len(back_s)} times lost, back after {np.median(back_s):.2f} s (median), "
        f"{np.percentile(back_s, 99):.2f} s (p99), {max(back_s):.2f} s (worst); "
        f"{before[0]} descriptors, {before[1]} threads before and after; {grown_kb} kB more memory after the first 100"
    )
    assert max(back_s) < BACK_S
    assert grown_kb < 10_000
