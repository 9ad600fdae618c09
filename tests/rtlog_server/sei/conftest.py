"""A driver that runs against emulated encoders, over a real pseudo-terminal."""

import math
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from hw_profiles.profile import Encoder, SeiBus
from rtlog_server.devices.device import TickGrid
from rtlog_server.devices.encoders import EncoderReading
from rtlog_server.devices.sei.driver import SeiEncoders

COUNTS = 4096
PERIOD_NS = 33_300_000  # no multiple of the 4 ms in which an encoder looks at its disc
ENCODERS = (
    Encoder(name="left_wheel", role="left_wheel", address=0, wheel_radius_m=0.35),
    Encoder(name="right_wheel", role="right_wheel", address=5, wheel_radius_m=0.35, reversed=True),
)
TURNS_PER_S = {0: 2.3, 5: -1.7}


class Bus:
    """A running driver, and what it has handed over at each tick."""

    def __init__(self, bus: SeiBus, encoders: tuple[Encoder, ...] = ENCODERS) -> None:
        self.grid = TickGrid(time.monotonic_ns(), PERIOD_NS)
        self.device = SeiEncoders("encoders", bus, encoders)
        self.device.start(self.grid)
        self.readings: list[EncoderReading] = []
        self.ages_s: list[float] = []

    def wait_for(self, condition: Callable[[], bool], timeout_s: float = 8.0) -> None:
        """Collect at each tick until the condition holds."""
        deadline_ns = time.monotonic_ns() + int(timeout_s * 1e9)
        while not condition():
            tick_ns = self.grid.next_after(time.monotonic_ns())
            assert tick_ns < deadline_ns, f"{self.device.message}; {self.device.diagnostics}"
            time.sleep(max(0, tick_ns - time.monotonic_ns()) * 1e-9)
            collected = self.device.collect(tick_ns)
            self.readings += collected.samples
            self.ages_s += [(tick_ns - sample.measured_ns) * 1e-9 for sample in collected.samples]

    def wait_for_readings(self, number: int) -> None:
        wanted = len(self.readings) + number
        self.wait_for(lambda: len(self.readings) >= wanted)

    def wait_until_back(self, readings: int = 1) -> float:
        """How long it takes until there are readings again, in s."""
        began_s = time.monotonic()
        self.wait_for_readings(readings)
        return time.monotonic() - began_s


@pytest.fixture
def link(tmp_path: Path) -> Path:
    return tmp_path / "sei"


@pytest.fixture
def counts() -> dict[int, int]:
    """The encoders on the bus, by address."""
    return {0: COUNTS, 5: COUNTS}


@pytest.fixture
def turning() -> Callable[[int, int], int]:
    """Two wheels at a steady speed: (address, monotonic ns) → counts over many turns."""
    return lambda address, at_ns: math.floor(at_ns * 1e-9 * TURNS_PER_S[address] * COUNTS)


@pytest.fixture
def start(link: Path) -> Iterator[Callable[..., Bus]]:
    """Starts a driver of the bus behind the link, with settings of the profile."""
    running: list[Bus] = []

    def start_bus(encoders: tuple[Encoder, ...] = ENCODERS, **settings: object) -> Bus:
        running.append(Bus(SeiBus(**{"port": str(link), **settings}), encoders))  # type: ignore[arg-type]
        return running[-1]

    yield start_bus
    for bus in running:
        bus.device.close()
