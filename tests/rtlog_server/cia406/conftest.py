"""Emulated encoders on a CAN bus, and their driver, collected at each tick."""

import math
import socket
import time
import uuid
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import pytest

from hw_profiles.profile import CanBus, Encoder
from rtlog_server.devices.cia406.driver import Cia406Encoders
from rtlog_server.devices.cia406.emulator import CanBusEmulator
from rtlog_server.devices.device import TickGrid
from rtlog_server.devices.encoders import EncoderReading

COUNTS = 4096
PERIOD_NS = 40_000_000
ENCODERS = (
    Encoder(name="left_wheel", role="left_wheel", address=5, wheel_radius_m=0.35),
    Encoder(name="right_wheel", role="right_wheel", address=9, wheel_radius_m=0.35, reversed=True),
)
TURNS_PER_S = {5: 2.3, 9: -1.7}


class Host:
    """A running driver, collected at each tick."""

    def __init__(self, bus: CanBus, encoders: tuple[Encoder, ...] = ENCODERS) -> None:
        self.grid = TickGrid(time.monotonic_ns(), PERIOD_NS)
        self.device = Cia406Encoders("encoders", bus, encoders)
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

    def wait_for_readings(self, number: int) -> list[EncoderReading]:
        """The next so many."""
        first = len(self.readings)
        self.wait_for(lambda: len(self.readings) >= first + number)
        return self.readings[first:]

    def wait_for_message(self, part: str) -> None:
        self.wait_for(lambda: part in self.device.message)


@pytest.fixture
def virtual() -> CanBus:
    return CanBus(interface="virtual", channel=uuid.uuid4().hex)


@pytest.fixture
def slcan(tmp_path: Path) -> CanBus:
    return CanBus(interface="slcan", channel=str(tmp_path / "slcan"))


@pytest.fixture
def udp() -> CanBus:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("", 0))
        return CanBus(interface="udp_multicast", channel="239.74.163.2", udp_port=probe.getsockname()[1])


@pytest.fixture
def two_wheels() -> tuple[Encoder, ...]:
    return ENCODERS


@pytest.fixture
def turning() -> Callable[[int, int], int]:
    """Two wheels at a steady speed: counts over many turns, of a node at a time [ns]."""
    return lambda node, at_ns: math.floor(at_ns * 1e-9 * TURNS_PER_S[node] * COUNTS)


@pytest.fixture
def emulate(turning: Callable[[int, int], int]) -> Callable[..., CanBusEmulator]:
    """emulate(bus, position, counts): the wheels that turn, unless it is told otherwise."""

    def emulator(
        bus: CanBus, position: Callable[[int, int], int] = turning, counts: Mapping[int, int] | None = None
    ) -> CanBusEmulator:
        return CanBusEmulator(bus, dict.fromkeys((5, 9), COUNTS) if counts is None else counts, position)

    return emulator


@pytest.fixture
def start() -> Iterator[Callable[..., Host]]:
    """Starts drivers and closes them at the end."""
    hosts: list[Host] = []

    def start_host(bus: CanBus, encoders: tuple[Encoder, ...] = ENCODERS) -> Host:
        hosts.append(Host(bus, encoders))
        return hosts[-1]

    yield start_host
    for host in hosts:
        host.device.close()
