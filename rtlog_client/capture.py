"""A captured byte stream of an LMS111, device to host, cut into telegrams: to be sent again as the bytes that came.

    … reply, reply | scan 1 | scan 2 | event, scan 3 | …        a piece ends with its scan and is sent at its time

In: the concatenated bytes of one direction, CoLa A or B. Out: `Piece`s, and the scans in them as `Event`s. Times are
nanoseconds since the first scan's transmission, by the device's own clock.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hw_profiles.errors import BadInputError
from rtlog_client.drive_log import Event
from rtlog_server.clock import WRAP_US
from rtlog_server.devices.lms111.cola import ColaError, Dialect, Receiver
from rtlog_server.devices.lms111.protocol import decode
from rtlog_server.devices.lms111.scan_data import ScanData
from rtlog_server.devices.lms111.sweep import period_us, to_scan
from rtlog_server.sampler import scan_message

BINARY_START = b"\x02\x02\x02\x02"


@dataclass(frozen=True, slots=True)
class Piece:
    elapsed_ns: int
    data: bytes
    scan: ScanData | None  # None: what came after the last one


@dataclass(frozen=True, slots=True)
class Capture:
    dialect: Dialect
    pieces: list[Piece]

    @property
    def scans(self) -> int:
        return sum(piece.scan is not None for piece in self.pieces)


def read_capture(path: Path) -> Capture:
    """Raises: BadInputError: no such file, or no scan of an LMS111 in it."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise BadInputError(f"{path}: {error.strerror or error}") from error
    dialect = Dialect.B if data.startswith(BINARY_START) else Dialect.A
    pieces = list(_pieces(data, dialect))
    if all(piece.scan is None for piece in pieces):
        raise BadInputError(f"{path}: no LMDscandata telegram in it, neither in CoLa A nor in CoLa B")
    return Capture(dialect, pieces)


def capture_events(capture: Capture, device: str) -> Iterator[Event]:
    """Each scan once (some devices send a telegram twice), as a LaserScan with the stamp of its first ray."""
    before: ScanData | None = None
    for order, piece in enumerate(capture.pieces):
        scan = piece.scan
        if scan is None or (before is not None and scan.telegram_counter == before.telegram_counter):
            continue
        measured = to_scan(scan, piece.elapsed_ns, period_us(scan, before))
        before = scan
        before_zero_ns = max(0, -measured.measured_ns)  # of the first: no header can be stamped so
        yield Event(measured.measured_ns, order, device, scan_message(measured, before_zero_ns, ""))


def transmission_delay_ns(capture: Capture) -> int:
    """From the last ray of a sweep to its transmission, at most; real scanners take half a turn, or one and a half."""
    events = {event.order: event for event in capture_events(capture, "")}
    return max(
        capture.pieces[order].elapsed_ns - event.stamp_ns - round(_sweep_s(event.content) * 1e9)
        for order, event in events.items()
    )


def _sweep_s(scan: Any) -> float:
    return float(scan.time_increment * max(len(scan.ranges) - 1, 0))


def _pieces(data: bytes, dialect: Dialect) -> Iterator[Piece]:
    receiver = Receiver(dialect)
    start = elapsed_us = 0
    last_us: int | None = None
    for end in range(1, len(data) + 1):  # a byte at a time: so the telegram's end in the stream is known
        for payload in receiver.feed(data[end - 1 : end]):
            scan = _scan(dialect, payload)
            if scan is None:
                continue
            now_us = scan.time_of_transmission_us
            elapsed_us += 0 if last_us is None else (now_us - last_us) % WRAP_US
            last_us = now_us
            yield Piece(elapsed_us * 1000, data[start:end], scan)
            start = end
    if start < len(data):
        yield Piece(elapsed_us * 1000, data[start:], None)


def _scan(dialect: Dialect, payload: bytes) -> ScanData | None:
    try:
        telegram = decode(dialect, payload)
    except ColaError:
        return None
    return telegram if isinstance(telegram, ScanData) else None
