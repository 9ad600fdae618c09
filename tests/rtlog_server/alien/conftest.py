"""A driver that runs against an emulated ALR-9650, over real sockets and a real pseudo-terminal."""

import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from patience import PATIENCE_S, Told

from hw_profiles.profile import RfidDevice
from rtlog_server.devices.alien.driver import Alr9650
from rtlog_server.devices.alien.emulator import Alr9650Emulator
from rtlog_server.devices.device import TickGrid
from rtlog_server.devices.rfid import TagSample

EPCS = [f"E2000016591900781840{number:04X}" for number in range(5)]


class Reader:
    """A running driver and what it has handed over so far."""

    def __init__(self, settings: RfidDevice) -> None:
        self.device = Alr9650("rfid", settings)
        self.told = Told(self.device)
        self.samples: list[TagSample] = []
        self.device.start(TickGrid(time.monotonic_ns(), 100_000_000))

    def wait_for(
        self,
        condition: Callable[[], bool],
    ) -> None:
        deadline_s = time.monotonic() + PATIENCE_S
        while not condition():
            assert time.monotonic() < deadline_s, f"{self.device.message}; {self.device.diagnostics}; {self.samples}"
            time.sleep(0.005)
            self.collect()

    def wait_for_message(self, part: str) -> None:
        """It may be over by then."""
        self.wait_for(lambda: self.told(part))

    def collect(self) -> int:
        collected = self.device.collect(time.monotonic_ns())
        self.samples += collected.samples
        return collected.state

    def wait_until_reading(self, stream: str = "open") -> None:
        self.wait_for(lambda: self.device.connected and self.device.diagnostics.get("stream") == stream)

    def wait_for_epc(self, epc: str) -> None:
        self.wait_for(lambda: any(sample.epc == epc for sample in self.samples))


@pytest.fixture
def link(tmp_path: Path) -> Path:
    """The stable name of the serial console."""
    return tmp_path / "usb-reader"


@pytest.fixture
def emulator(link: Path) -> Iterator[Alr9650Emulator]:
    with Alr9650Emulator(link=link) as emulated:
        yield emulated


@pytest.fixture
def start_with() -> Iterator[Callable[[RfidDevice], Reader]]:
    readers: list[Reader] = []

    def start_reader(settings: RfidDevice) -> Reader:
        readers.append(Reader(settings))
        return readers[-1]

    yield start_reader
    for reader in readers:
        reader.device.close()


@pytest.fixture
def start(start_with: Callable[[RfidDevice], Reader]) -> Callable[..., Reader]:
    """Over TCP to a port, with settings of the profile."""
    return lambda port, **settings: start_with(RfidDevice(host="127.0.0.1", port=port, **settings))


@pytest.fixture(params=["tcp", "serial"])
def start_on_wire(
    request: pytest.FixtureRequest, start_with: Callable[[RfidDevice], Reader], link: Path
) -> Callable[[int], Reader]:
    """Over TCP, and over the serial line."""
    if request.param == "tcp":
        return lambda port: start_with(RfidDevice(host="127.0.0.1", port=port))
    return lambda _: start_with(RfidDevice(serial_port=str(link)))


@pytest.fixture
def epcs() -> list[str]:
    return EPCS
