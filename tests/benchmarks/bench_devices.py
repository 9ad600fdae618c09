"""How soon it is known what devices tell: a scan decoded, a tag's read pushed, encoders on CAN read before the tick.

The emulated devices run in this process; what else the machine does at that moment shows. A2 encoders are measured by
bench_sei.py, scanners over minutes by the long tests.
"""

import sys
import time
import uuid
from collections.abc import Callable

import numpy as np
from table import Figure, report

from hw_profiles.profile import CanBus, Encoder, RfidDevice
from rtlog_server.devices.alien.driver import Alr9650
from rtlog_server.devices.alien.emulator import Alr9650Emulator
from rtlog_server.devices.cia406.driver import Cia406Encoders
from rtlog_server.devices.cia406.emulator import CanBusEmulator
from rtlog_server.devices.device import TickGrid
from rtlog_server.devices.lms111.cola import Dialect, Receiver
from rtlog_server.devices.lms111.protocol import decode
from rtlog_server.devices.lms111.scan_data import Channel, ScanData, encode_scan_data

PERIOD_NS = 100_000_000
READS, ROUNDS, TELEGRAMS = 101, 50, 500
SETTLED = 10  # rounds, after which the lead fits the bus
WHEELS = [
    Encoder(name="left_wheel", role="left_wheel", address=5, wheel_radius_m=0.35),
    Encoder(name="right_wheel", role="right_wheel", address=9, wheel_radius_m=0.35),
]


def decoding_us() -> float:
    """The least time that a telegram of 541 ranges takes from bytes to arrays."""
    channel = Channel("DIST1", 1.0, 0.0, -450_000, 5000, np.arange(541, dtype=np.uint16))
    scan = ScanData(1, 1, 1, (0, 0), 1, 1, 0, 23_000, (0, 0), (0, 0), 0, 5000, 360, (), (channel,), ())
    telegram, receiver, times_s = encode_scan_data(Dialect.B, scan), Receiver(Dialect.B), []
    for _ in range(TELEGRAMS):
        began_s = time.perf_counter()
        for payload in receiver.feed(telegram):
            decode(Dialect.B, payload)
        times_s.append(time.perf_counter() - began_s)
    return 1e6 * min(times_s)


def push_ms() -> float:
    """From a tag's read to its sample, median."""
    latencies_ns: list[int] = []
    with Alr9650Emulator() as emulator:
        device = Alr9650("rfid", RfidDevice(host="127.0.0.1", port=emulator.port))
        device.start(TickGrid(time.monotonic_ns(), PERIOD_NS))
        _wait_until(lambda: device.diagnostics.get("stream") == "open")
        for number in range(READS):
            read_ns = time.monotonic_ns()
            emulator.read_tag(f"E2000016591900781840{number:04X}")
            _wait_until(lambda: latencies_ns.extend(_arrived(device, read_ns)) or len(latencies_ns) > number)  # noqa: B023
        device.close()
    return float(np.median(latencies_ns)) * 1e-6


def _arrived(device: Alr9650, since_ns: int) -> list[int]:
    return [sample.complete_ns - since_ns for sample in device.collect(time.monotonic_ns()).samples]


def can_age_ms() -> float:
    """From the moment at which encoders on CAN were latched to the tick, median."""
    bus, ages_ns = CanBus(interface="virtual", channel=uuid.uuid4().hex), []
    with CanBusEmulator(bus, {5: 4096, 9: 4096}, lambda _, at_ns: at_ns // 100_000):
        device, grid = Cia406Encoders("encoders", bus, WHEELS), TickGrid(time.monotonic_ns(), PERIOD_NS)
        device.start(grid)
        while len(ages_ns) < SETTLED + ROUNDS:
            tick_ns = grid.next_after(time.monotonic_ns())
            time.sleep(max(0, tick_ns - time.monotonic_ns()) * 1e-9)
            ages_ns += [tick_ns - reading.measured_ns for reading in device.collect(tick_ns).samples]
        device.close()
    return float(np.median(ages_ns[SETTLED:])) * 1e-6


def _wait_until(condition: Callable[[], bool]) -> None:
    while not condition():
        time.sleep(0.001)


def main() -> int:
    return report(
        "devices",
        [
            Figure("a scan of 541 ranges is decoded in", decoding_us(), "µs", most=100.0),
            Figure("a tag's read is pushed within, median", push_ms(), "ms", most=10.0),
            Figure("encoders on CAN are latched before the tick, median", can_age_ms(), "ms", most=15.0),
        ],
    )


if __name__ == "__main__":
    sys.exit(main())
