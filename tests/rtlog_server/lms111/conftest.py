"""An emulated scanner that measures, a driver in its thread, and what a tick thread collects from it."""

import math
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from hw_profiles.profile import LaserDevice
from rtlog_server.devices.device import TickGrid
from rtlog_server.devices.laser import Scan
from rtlog_server.devices.lms111.driver import Lms111
from rtlog_server.devices.lms111.emulator import Lms111Emulator
from rtlog_server.messages import MISSING


def wait_until(condition: Callable[[], object], timeout_s: float = 5.0) -> None:
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, f"not within {timeout_s} s"
        time.sleep(0.005)


class Feeder:
    """Lets an emulated scanner measure; ray 0 of scan k is at 1 m + k mm, ray 1 without return, ray 2 rejected."""

    def __init__(
        self,
        emulator: Lms111Emulator,
        rays: int = 541,
        start_deg: float = -135.0,
        step_deg: float = 0.5,
        period_s: float = 0.02,
        second_echo: Callable[[int], tuple[np.ndarray, np.ndarray]] | None = None,
    ) -> None:
        self.emulator = emulator
        self.rays, self.start_rad, self.step_rad = rays, math.radians(start_deg), math.radians(step_deg)
        self.first_rays_ns: list[int] = []
        self._period_s = period_s
        self._second_echo = second_echo
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def ranges_m(self, k: int) -> np.ndarray:
        ranges = 3.0 + np.arange(self.rays) * 1e-3
        ranges[:3] = 1.0 + k * 1e-3, np.inf, np.nan
        return ranges

    def index(self, scan: Scan) -> int:
        return round((float(scan.ranges_m[0]) - 1.0) * 1e3)

    def errors_ms(self, scans: list[Scan]) -> np.ndarray:
        """(N,) stamps of the first rays against the truth."""
        return np.array([scan.measured_ns - self.first_rays_ns[self.index(scan)] for scan in scans]) * 1e-6

    def _run(self) -> None:
        due = time.monotonic()
        while not self._stopping.wait(max(0.0, due - time.monotonic())):
            due += self._period_s
            k = len(self.first_rays_ns)
            self.first_rays_ns.append(time.monotonic_ns())
            second = () if self._second_echo is None else self._second_echo(k)
            remission = np.arange(self.rays) * 10.0
            first_ray_ns = self.first_rays_ns[k]
            self.emulator.send_scan(self.ranges_m(k), first_ray_ns, self.start_rad, self.step_rad, remission, *second)

    def stop(self) -> None:
        self._stopping.set()
        self._thread.join()


class Drive:
    """A driver in its thread, and what a tick thread collects from it."""

    def __init__(self, address: tuple[str, int], **settings: Any) -> None:
        self.driver = Lms111("laser/primary", LaserDevice(host=address[0], port=address[1], **settings))
        self.scans: list[Scan] = []
        self.state = MISSING
        self.driver.start(TickGrid(0, 100_000_000))

    def collect(self) -> list[Scan]:
        collected = self.driver.collect(time.monotonic_ns())
        self.scans += collected.samples
        self.state = collected.state
        return collected.samples

    def wait_scans(self, count: int, timeout_s: float = 5.0) -> list[Scan]:
        """This many scans more."""
        have = len(self.scans)
        wait_until(lambda: self.collect() is not None and len(self.scans) >= have + count, timeout_s)
        return self.scans[have:]

    def wait_message(self, text: str, timeout_s: float = 5.0) -> None:
        wait_until(lambda: text in self.driver.message, timeout_s)

    def wait_lost(self) -> None:
        """Wait until the driver has noticed; scans that are still under way are let go."""
        wait_until(lambda: not self.driver.connected, 2.0)
        time_ns = time.monotonic_ns()
        wait_until(lambda: self.driver.collect(time_ns).samples == [])


@pytest.fixture(name="wait_until")
def wait_until_fixture() -> Callable[..., None]:
    """Waits for a condition, with a deadline."""
    return wait_until


@pytest.fixture
def open_drive() -> Iterator[Callable[..., Drive]]:
    """Starts a driver for the scanner at an address, with settings as in the profile."""
    drives: list[Drive] = []

    def open_drive(address: tuple[str, int], **settings: Any) -> Drive:
        drives.append(Drive(address, **settings))
        return drives[-1]

    yield open_drive
    for drive in drives:
        drive.driver.close()


@pytest.fixture
def feed() -> Iterator[Callable[..., Feeder]]:
    """Lets an emulated scanner measure; both end with the test."""
    feeders: list[Feeder] = []

    def feed(emulator: Lms111Emulator, **options: Any) -> Feeder:
        feeders.append(Feeder(emulator, **options))
        return feeders[-1]

    yield feed
    for feeder in feeders:
        feeder.stop()
        feeder.emulator.close()
