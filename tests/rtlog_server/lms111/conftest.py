"""An emulated scanner that measures, a driver in its thread, and what a tick thread collects from it."""

import math
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from patience import Told, wait_until

from hw_profiles.profile import LaserDevice
from rtlog_server.devices.device import TickGrid
from rtlog_server.devices.laser import Scan
from rtlog_server.devices.lms111 import driver
from rtlog_server.devices.lms111.driver import Lms111
from rtlog_server.devices.lms111.emulator import Lms111Emulator
from rtlog_server.messages import MISSING

ROUNDED_NS = 300_000  # what a clock that drifts by 100 ppm, and counts microseconds, may be off by in some seconds


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

    def assert_true_stamps(self, scans: list[Scan], arrived_ns: list[int]) -> None:
        """No first ray is stamped earlier than it was, or later by more than the fastest delivery so far took.

        So it must be however late the threads of either end run: from the last ray to the arrival takes longer still.
        """
        first_rays_ns = np.array([self.first_rays_ns[self.index(scan)] for scan in scans])
        late_ns = np.array([scan.measured_ns for scan in scans]) - first_rays_ns
        sweeps_ns = np.array([scan.complete_ns - scan.measured_ns for scan in scans])
        delivered_ns = np.array(arrived_ns) - first_rays_ns - sweeps_ns
        assert late_ns.min() > -ROUNDED_NS
        assert np.all(late_ns < np.minimum.accumulate(delivered_ns) + ROUNDED_NS)

    def _run(self) -> None:
        due_ns = time.monotonic_ns()
        while not self._stopping.wait(max(0.0, (due_ns - time.monotonic_ns()) * 1e-9)):
            k = len(self.first_rays_ns)
            self.first_rays_ns.append(due_ns)  # a motor keeps its pace, whenever this thread wakes up
            due_ns += int(self._period_s * 1e9)
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
        self.told = Told(self.driver)
        self.scans: list[Scan] = []
        self.arrived_ns: list[int] = []  # when the driver had each of them, and of those that are not collected yet
        self._hand_over, self.driver.hand_over = self.driver.hand_over, self._note_arrival  # type: ignore[method-assign]
        self.state = MISSING
        self.driver.start(TickGrid(0, 100_000_000))

    def collect(self) -> list[Scan]:
        collected = self.driver.collect(time.monotonic_ns())
        self.scans += collected.samples
        self.state = collected.state
        return collected.samples

    def _note_arrival(self, scan: Scan) -> None:
        self.arrived_ns.append(time.monotonic_ns())
        self._hand_over(scan)

    def wait_scans(self, count: int) -> list[Scan]:
        """This many scans more."""
        have = len(self.scans)
        wait_until(lambda: self.collect() is not None and len(self.scans) >= have + count, lambda: self.driver.message)
        return self.scans[have:]

    def wait_state(self, state: int) -> None:
        wait_until(lambda: self.collect() is not None and self.state == state, lambda: self.driver.message)

    def wait_message(self, text: str) -> None:
        """It may be over by then."""
        wait_until(lambda: self.told(text), lambda: self.driver.message)

    def lose(self, how: Callable[[], object]) -> list[Scan]:
        """Lose the connection in this way, and wait until the driver is back; scans from before and after it."""
        have, connects = len(self.scans), self.driver.connects
        how()
        wait_until(lambda: self.driver.connects > connects, lambda: self.driver.message)
        self.collect()
        return self.scans[have:]


@pytest.fixture(autouse=True)
def patient_driver(monkeypatch: pytest.MonkeyPatch) -> None:
    """A scanner that sends nothing for a while is asked, and on a busy machine its answer may take long."""
    monkeypatch.setattr(driver, "PROBE_S", 10.0)


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
    for feeder in feeders:  # several may have fed one
        feeder.emulator.close()
