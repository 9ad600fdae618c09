"""The reader's driver for longer: a thousand connections lost in every way, over both of its wires.

What each test measured is printed (pytest -s, or -rP).
"""

import resource
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from hw_profiles.profile import RfidDevice
from rtlog_server.devices.alien.driver import Alr9650
from rtlog_server.devices.alien.emulator import Alr9650Emulator
from rtlog_server.devices.device import TickGrid

RECONNECTS = 1000  # half of them over each wire
BACK_S = 2.0
DEADLINE_S = 15.0


def lose(emulator: Alr9650Emulator, number: int, wire: str) -> None:
    """Most connections are reset or pulled; some after garbage; some readers fall silent, are busy or reboot."""
    if number % 50 == 0:
        emulator.silent = True
        time.sleep(3.0)  # longer than a driver waits
        emulator.silent = False
    elif number % 50 == 1:
        emulator.power_off()
        time.sleep(0.3)
        emulator.power_on()
    elif wire == "serial":
        emulator.unplug()
        time.sleep(0.02 * (number % 3))
        emulator.replug()
    elif number % 50 == 2:
        emulator.busy = True
        emulator.reset_connections()
        time.sleep(0.5)
        emulator.busy = False
    else:
        if number % 3 == 0:
            emulator.babble([b"\xff\0garbage\0;;;", b"set AutoMode"][number % 2])
        emulator.reset_connections()


def in_use() -> tuple[int, int]:
    """Descriptors and threads of this process."""
    return len(list(Path("/proc/self/fd").iterdir())), threading.active_count()


def wait_for_reads(driver: Alr9650, emulator: Alr9650Emulator, connects: int) -> None:
    """Until a tag is read over a connection newer than `connects`."""
    deadline = time.monotonic() + DEADLINE_S
    while not (driver.connected and driver.connects > connects):
        assert time.monotonic() < deadline, driver.message
        time.sleep(0.002)
    driver.collect(time.monotonic_ns())
    emulator.read_tag("E20000165919007818405C7B")
    while not driver.collect(time.monotonic_ns()).samples:
        assert time.monotonic() < deadline, driver.message
        time.sleep(0.002)


@pytest.mark.timeout(1800)
@pytest.mark.parametrize("wire", ["tcp", "serial"])
def test_a_thousand_reconnects(wire: str, tmp_path: Path) -> None:
    """Half of them over each wire: back within two seconds each time, and nothing left behind."""
    back_s, memory_kb = [], 0
    link = tmp_path / "reader"
    with Alr9650Emulator(link=link) as emulator:
        tcp, serial = RfidDevice(host="127.0.0.1", port=emulator.port), RfidDevice(serial_port=str(link))
        driver = Alr9650("rfid", tcp if wire == "tcp" else serial)
        driver.start(TickGrid(time.monotonic_ns(), 100_000_000))
        wait_for_reads(driver, emulator, 0)
        before = in_use()
        for number in range(RECONNECTS // 2):
            connects = driver.connects
            lose(emulator, number, wire)
            returned = time.monotonic()
            wait_for_reads(driver, emulator, connects)
            back_s.append(time.monotonic() - returned)
            if number == 100:
                memory_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        grown_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - memory_kb
        deadline = time.monotonic() + DEADLINE_S
        while in_use() != before and time.monotonic() < deadline:  # the emulator's last sessions end
            time.sleep(0.01)
        assert in_use() == before
        driver.close()
    print(
        f"{wire}: {len(back_s)} reconnects, back after {np.median(back_s):.2f} s (median), "
        f"{np.percentile(back_s, 99):.2f} s (p99), {max(back_s):.2f} s (worst); "
        f"{before[0]} descriptors, {before[1]} threads before and after; {grown_kb} kB more memory after the first 100"
    )
    assert max(back_s) < BACK_S
    assert grown_kb < 10_000
