"""A thousand reconnects to encoders on CAN by the driver's own thread: no thread, descriptor or memory stays behind."""

import gc
import socket
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import can
import pytest

from hw_profiles.profile import CanBus, Encoder
from rtlog_server.devices.cia406.driver import Cia406Encoders
from rtlog_server.devices.cia406.emulator import CanBusEmulator
from rtlog_server.devices.device import TickGrid

COUNTS = 4096
ENCODERS = [
    Encoder(name="left_wheel", role="left_wheel", address=5, wheel_radius_m=0.35),
    Encoder(name="right_wheel", role="right_wheel", address=6, wheel_radius_m=0.35),
]
RECONNECTS = {"virtual": 100, "udp_multicast": 1000, "slcan": 300}
WARM_UP = 20
GROWTH_BYTES = 4_000_000  # of a process that has just warmed up; a leak of a reconnect's frames is several times that


def bus_of(interface: str, folder: Path) -> CanBus:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("", 0))
        udp_port = probe.getsockname()[1]
    channels = {"virtual": uuid.uuid4().hex, "udp_multicast": "239.74.163.2", "slcan": str(folder / "slcan")}
    return CanBus(interface=interface, channel=channels[interface], udp_port=udp_port)


def descriptors() -> int:
    return len(list(Path("/proc/self/fd").iterdir()))


def resident_bytes() -> int:
    gc.collect()
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096


class HurriedEncoders(Cia406Encoders):
    """Waits for nothing between two attempts."""

    def pause(self, seconds: float) -> bool:
        return super().pause(min(seconds, 0.001))


def wait_until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 20.0
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.002)


@contextmanager
def breaker(bus: CanBus, emulator: CanBusEmulator) -> Iterator[Callable[[Cia406Encoders], None]]:
    """What breaks the connection and mends it: an adapter pulled and put back, or a controller that reports bus-off."""
    if bus.interface == "slcan":

        def replug(device: Cia406Encoders) -> None:
            emulator.unplug()
            wait_until(lambda: not device.connected)
            emulator.replug()

        yield replug
        return
    port = {"port": bus.udp_port, "hop_limit": 0} if bus.interface == "udp_multicast" else {}
    with can.Bus(interface=bus.interface, channel=bus.channel, **port) as controller:
        bus_off = can.Message(arbitration_id=0x40, is_error_frame=True, is_extended_id=False, data=bytes(8))
        yield lambda _device: controller.send(bus_off)


@pytest.mark.parametrize("interface", list(RECONNECTS))
@pytest.mark.timeout(1200)
def test_a_thousand_reconnects_leave_nothing_behind(interface: str, tmp_path: Path) -> None:
    bus = bus_of(interface, tmp_path)
    position = lambda _node, at_ns: at_ns * COUNTS // 10**9  # noqa: E731
    with CanBusEmulator(bus, {5: COUNTS, 6: COUNTS}, position) as emulator, breaker(bus, emulator) as break_connection:
        device = HurriedEncoders("encoders", bus, ENCODERS)
        device.start(TickGrid(time.monotonic_ns(), 20_000_000))
        counts = []
        for number in range(WARM_UP + RECONNECTS[interface] + 1):
            wait_until(lambda number=number: device.connects == number + 1)
            wait_until(lambda: bool(device.collect(time.monotonic_ns()).samples))
            if number in (WARM_UP, WARM_UP + RECONNECTS[interface]):
                counts.append((threading.active_count(), descriptors(), resident_bytes()))
            if number < WARM_UP + RECONNECTS[interface]:
                break_connection(device)
        device.close()
    (threads, files, resident), (threads_after, files_after, resident_after) = counts
    assert (threads_after, files_after) == (threads, files)
    assert resident_after - resident < GROWTH_BYTES
