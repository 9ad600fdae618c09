"""The LMS111's driver for longer: a thousand connections lost in every way, and stamps over minutes of jitter.

What each test measured is printed (pytest -s, or -rP).
"""

import math
import resource
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import numpy as np
import pytest

from hw_profiles.profile import LaserDevice
from rtlog_server.devices.device import TickGrid
from rtlog_server.devices.laser import Scan
from rtlog_server.devices.lms111.driver import Lms111
from rtlog_server.devices.lms111.emulator import Lms111Emulator

RECONNECTS = 1000
BACK_S = 2.0
DEADLINE_S = 10.0
STEP_RAD = math.radians(0.5)


@contextmanager
def measuring(emulator: Lms111Emulator, first_rays_ns: list[int]) -> Iterator[None]:
    """Let the scanner measure at 50 Hz; ray 0 of scan k is at 1 m + k mm, of rays of up to 60 m."""
    stopping = threading.Event()

    def run() -> None:
        ranges_m = np.full(541, 3.0)
        due = time.monotonic()
        while not stopping.wait(max(0.0, due - time.monotonic())):
            due = max(due + 0.02, time.monotonic())
            ranges_m[0] = 1.0 + len(first_rays_ns) * 1e-3
            first_rays_ns.append(time.monotonic_ns())
            emulator.send_scan(ranges_m, first_rays_ns[-1], math.radians(-135), STEP_RAD)

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield
    finally:
        stopping.set()
        thread.join()


@contextmanager
def driving(emulator: Lms111Emulator) -> Iterator[Lms111]:
    driver = Lms111("laser/primary", LaserDevice(host=emulator.address[0], port=emulator.address[1]))
    driver.start(TickGrid(0, 100_000_000))
    with closing(driver):
        yield driver


def wait_scans(driver: Lms111) -> list[Scan]:
    deadline = time.monotonic() + DEADLINE_S
    while not (scans := driver.collect(time.monotonic_ns()).samples):
        assert time.monotonic() < deadline, driver.message
        time.sleep(0.002)
    return scans


def lose(emulator: Lms111Emulator, number: int) -> None:
    """Most connections are reset or closed; some in the middle of a telegram or of garbage; some devices go away."""
    away_s = 1.0 + number % 7 / 2  # long enough for the driver to try but once a second
    if number % 50 == 0:
        emulator.go_silent()
        time.sleep(away_s)
        emulator.go_silent(False)
    elif number % 50 == 1:
        emulator.refuse()
        time.sleep(away_s)
        emulator.refuse(False)
    elif number % 50 == 2:
        emulator.power_cycle(off_s=0.3)
        time.sleep(0.3)
    else:
        if number % 3 == 0:
            emulator.send_raw([b"\x02\x02\x02\x02\0\0\x04\x9esSN LMDscandata \0", b"\x02\xff\x03"][number % 2])
        emulator.drop_connection(reset=number % 4 != 0)


def in_use() -> tuple[int, int]:
    """Descriptors and threads of this process."""
    return len(list(Path("/proc/self/fd").iterdir())), threading.active_count()


@pytest.mark.timeout(1800)
@pytest.mark.parametrize("dialect", ["A", "B"])
def test_a_thousand_reconnects(dialect: str) -> None:
    """Half of them in each dialect: back within two seconds each time, and nothing left behind."""
    back_s = []
    with Lms111Emulator(dialect=dialect) as emulator, measuring(emulator, []), driving(emulator) as driver:
        wait_scans(driver)
        before, memory_kb = in_use(), 0
        for number in range(RECONNECTS // 2):
            connects = driver.connects
            lose(emulator, number)
            returned = time.monotonic()
            while driver.connects == connects:  # scans of the connection that is lost may still lie in the inbox
                assert time.monotonic() - returned < DEADLINE_S, driver.message
                time.sleep(0.002)
            driver.collect(time.monotonic_ns())
            wait_scans(driver)
            back_s.append(time.monotonic() - returned)
            if number == 100:
                memory_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        grown_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - memory_kb
        assert in_use() == before
    print(
        f"CoLa {dialect}: {len(back_s)} reconnects, back after {np.median(back_s):.2f} s (median), "
        f"{np.percentile(back_s, 99):.2f} s (p99), {max(back_s):.2f} s (worst); "
        f"{before[0]} descriptors, {before[1]} threads before and after; {grown_kb} kB more memory after the first 100"
    )
    assert max(back_s) < BACK_S
    assert grown_kb < 10_000


def network(seed: int) -> Callable[[], int]:
    """Delays as of a switch with other traffic: 0.1 ms, exponential jitter of 1 ms, one in ten 15 ms more."""
    rng = np.random.default_rng(seed)
    return lambda: int(100_000 + rng.exponential(1e6) + 15e6 * (rng.random() < 0.1))


@pytest.mark.timeout(600)
@pytest.mark.parametrize(("dialect", "drift_ppm"), [("A", 120.0), ("B", -60.0)])
def test_stamps_of_the_first_ray(dialect: str, drift_ppm: float) -> None:
    """A minute in which the device's count wraps, then a power cycle and half a minute more: 1 ms at p99."""
    first_rays_ns: list[int] = []
    scans: list[Scan] = []
    wraps_in_half_a_minute = 2**32 - 30_000_000
    with Lms111Emulator(dialect=dialect, clock_offset_us=wraps_in_half_a_minute, clock_drift_ppm=drift_ppm) as emulator:
        emulator.set_delivery(network(1))
        with driving(emulator) as driver:
            assert emulator.wait_streaming(DEADLINE_S)
            with measuring(emulator, first_rays_ns):
                ends = time.monotonic() + 60
                while time.monotonic() < ends:
                    scans += wait_scans(driver)
                emulator.power_cycle()
                ends = time.monotonic() + 30
                while time.monotonic() < ends:
                    scans += wait_scans(driver)
        lost, connects = driver.diagnostics["scans lost"], driver.connects
    truth_ns = np.array([first_rays_ns[round((float(scan.ranges_m[0]) - 1.0) * 1e3)] for scan in scans])
    errors_ms = np.abs(np.array([scan.measured_ns for scan in scans]) - truth_ns) * 1e-6
    print(
        f"CoLa {dialect}, {drift_ppm:g} ppm: {len(scans)} stamps wrong by {np.median(errors_ms):.3f} ms (median), "
        f"{np.percentile(errors_ms, 99):.3f} ms (p99), {errors_ms.max():.3f} ms (worst)"
    )
    assert (connects, lost) == (2, "0")
    assert len(scans) > 4000
    assert np.percentile(errors_ms, 99) < 1.0
