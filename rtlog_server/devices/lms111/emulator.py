"""The device's end of an LMS111, as a TCP server in a thread of its own.

In: sweeps from outside, each with the host time of its first ray. Out: what a scanner sends. The law: to a client it is
a scanner. It serves one client at a time, streams only to one that asked for it, sends no sweep before its last ray.

    send_scan, faults ──> queue ──> the thread, which owns all state ──> sockets

Its faults are those of the field: a cable pulled, a connection cut, a port that refuses, a power cycle, bytes that are
no telegram.
"""

import socket
import struct
import threading
import time
from collections.abc import Callable
from typing import Self

from numpy.typing import ArrayLike

from rtlog_server.devices.lms111.cola import ColaError, Dialect, Receiver
from rtlog_server.devices.lms111.emulated_scanner import EmulatedScanner
from rtlog_server.devices.lms111.emulated_sweep import Sweep, make_sweep
from rtlog_server.devices.lms111.event_loop import EventLoop
from rtlog_server.devices.lms111.protocol import (
    CONDITION_FAILED,
    INVALID_DATA,
    MEASURING,
    REPLY_VERBS,
    decode,
    encode_command,
)
from rtlog_server.devices.lms111.scan_data import ScanData, encode_scan_data

READY_AFTER_NS = 500_000  # from the last ray to the transmission
SEND_S = 1.0
RESET_ON_CLOSE = struct.pack("ii", 1, 0)  # SO_LINGER: close() sends RST, as a device that lost its power does


class Lms111Emulator:
    """A scanner at `address`, powered up at construction, until close().

    Args:
        host: the address to listen on.
        port: 0 takes any.
        dialect: what the port speaks, "A" or "B".
        serial_no, clock_offset_us, clock_drift_ppm, start_s, telegrams: as in `EmulatedScanner`.

    Raises:
        OSError: the port cannot be opened.
    """

    def __init__(
        self,
        host: str = "127.0.0.1",
        port: int = 0,
        dialect: str = "B",
        *,
        serial_no: int = 18090362,
        clock_offset_us: int = 0,
        clock_drift_ppm: float = 0.0,
        start_s: float = 0.0,
        telegrams: int = 0,
    ) -> None:
        clock = clock_offset_us, clock_drift_ppm
        self._scanner = EmulatedScanner(time.monotonic_ns(), serial_no, dialect == "B", *clock, start_s, telegrams)
        self._listener: socket.socket | None = socket.create_server((host, port))
        self.address: tuple[str, int] = self._listener.getsockname()[:2]
        self._client: socket.socket | None = None
        self._dialect = Dialect.B
        self._receiver = Receiver(self._dialect)
        self._silent = False
        self._streaming = threading.Event()
        self._delay_ns: Callable[[], int] = lambda: 0
        self._sent_by_ns = 0
        self._errors: dict[str, int] = {}
        self._loop = EventLoop("lms111 emulator")
        self._loop.watch(self._listener, self._accept)
        self._closed = False
        self._loop.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        if not self._closed:
            self._closed = True
            self._loop.call(self._stop_listening)
            self._loop.close()

    # For whoever drives it

    def wait_streaming(self, timeout_s: float) -> bool:
        """Wait until a client is registered for scans; whether one is."""
        return self._streaming.wait(timeout_s)

    def send_scan(
        self,
        ranges_m: ArrayLike,
        first_ray_ns: int,
        angle_min_rad: float,
        angle_increment_rad: float,
        intensities: ArrayLike | None = None,
        second_ranges_m: ArrayLike | None = None,
        second_intensities: ArrayLike | None = None,
    ) -> None:
        """Measure and send a sweep; returns at once, the scan goes out after its last ray.

        Args:
            ranges_m: (N,) +inf: no return, NaN: rejected; sent in whole millimetres.
            first_ray_ns: when the first ray was measured (monotonic).
            angle_min_rad: of the first ray, in the scanner's frame.
            angle_increment_rad: above 0, up to 6.5°.
            intensities: (N,) sent if the client asked for remission; None or empty: there are none.
            second_ranges_m: (N,) of the second echo; +inf for a ray that has none; None: no ray has one.
            second_intensities: (N,) of the second echo.

        Raises:
            ValueError: no scanner can measure such a sweep.
        """
        second = second_ranges_m, second_intensities
        sweep = make_sweep(ranges_m, first_ray_ns, angle_min_rad, angle_increment_rad, intensities, *second)
        self._loop.post(self._measure, sweep)

    def send_raw(self, data: bytes) -> None:
        """Put any bytes on the wire."""
        self._loop.call(self._send, data)

    def set_status(self, status: int) -> None:
        """The device status of the scans from now on: 1 error, 2 contamination warning, 4 contamination error."""
        self._loop.call(setattr, self._scanner, "device_status", (0, status))

    def set_temperature(self, outside: bool) -> None:
        """Whether it is outside of its temperature range."""
        self._loop.call(setattr, self._scanner, "outside_temperature", outside)

    def set_delivery(self, delay_ns: Callable[[], int]) -> None:
        """How long each scan is under way from its transmission on; a connection keeps their order."""
        self._loop.call(setattr, self, "_delay_ns", delay_ns)

    def set_error(self, command: str, code: int | None) -> None:
        """Answer a command, as in `sRN LMPscancfg`, with the error `code` from now on; None: as usual again."""
        self._loop.call(self._errors.pop if code is None else self._errors.__setitem__, command, code)

    def stop_streaming(self) -> None:
        """Forget that the client is registered for scans; go on answering it."""
        self._loop.call(self._forget_registration)

    def drop_connection(self, reset: bool = True) -> None:
        """Reset the client's connection, or close it in good order."""
        self._loop.call(self._hang_up, reset)

    def go_silent(self, silent: bool = True) -> None:
        """Say nothing more, as if the cable were pulled; new connections are taken and met with silence."""
        self._loop.call(setattr, self, "_silent", silent)

    def refuse(self, refusing: bool = True) -> None:
        """Reset the connection and refuse new ones; or take them again."""
        self._loop.call(self._stop_listening if refusing else self._listen)

    def power_cycle(self, off_s: float = 0.5) -> None:
        """Lose power without a word; back with counters, clock and configuration as after any power-up."""
        self._loop.call(self._power_off, off_s)

    # In the thread

    def _measure(self, sweep: Sweep) -> None:
        self._loop.at(self._scanner.last_ray_ns(sweep) + READY_AFTER_NS, self._transmit, sweep)

    def _transmit(self, sweep: Sweep) -> None:
        now_ns = time.monotonic_ns()
        if self._scanner.streaming and self._scanner.state(now_ns) == MEASURING and not self._silent:
            data = encode_scan_data(self._dialect, self._scanner.scan_data(sweep, now_ns))
            self._sent_by_ns = max(self._sent_by_ns, now_ns + self._delay_ns())
            if self._sent_by_ns > now_ns:
                self._loop.at(self._sent_by_ns, self._send_to, self._client, data)
            else:
                self._send(data)

    def _send_to(self, client: socket.socket | None, data: bytes) -> None:
        """Send what was under way, unless the connection that it was for is gone."""
        if self._client is client and not self._silent:
            self._send(data)

    def _accept(self) -> None:
        assert self._listener is not None
        connection, _ = self._listener.accept()
        while self._client is not None and self._receive():
            pass  # it may have hung up after its last words
        if self._client is not None:
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, RESET_ON_CLOSE)
            connection.close()
            return
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._client = connection
        self._dialect = Dialect.B if self._scanner.speaks_cola_b else Dialect.A
        self._receiver = Receiver(self._dialect)
        self._loop.watch(connection, self._receive)

    def _receive(self) -> bool:
        """Take and answer what the client sent; False: there was nothing."""
        if self._client is None:
            return False  # it went while an earlier event was handled
        try:
            data = self._client.recv(65536)
        except BlockingIOError:
            return False
        except OSError:
            data = b""
        if not data:
            self._hang_up(False)
        elif not self._silent:
            for payload in self._receiver.feed(data):
                self._send(self._answer(payload))
        return True

    def _answer(self, payload: bytes) -> bytes:
        try:
            command = decode(self._dialect, payload)
        except ColaError:
            command = None
        if command is None or isinstance(command, ScanData) or command.name[:3] not in REPLY_VERBS:
            return encode_command(self._dialect, "sFA", INVALID_DATA)
        if command.name in self._errors:
            return encode_command(self._dialect, "sFA", self._errors[command.name])
        if command.name == "sRN LMDscandata":
            newest = self._scanner.newest
            if newest is None:
                return encode_command(self._dialect, "sFA", CONDITION_FAILED)
            return encode_scan_data(self._dialect, newest, "sRA LMDscandata")
        reply = self._scanner.answer(command, time.monotonic_ns())
        (self._streaming.set if self._scanner.streaming else self._streaming.clear)()
        return encode_command(self._dialect, reply.name, *reply.values)

    def _send(self, data: bytes) -> None:
        if self._client is not None:
            try:
                self._client.settimeout(SEND_S)
                self._client.sendall(data)
                self._client.setblocking(False)
            except OSError:
                self._hang_up(False)

    def _hang_up(self, reset: bool) -> None:
        if self._client is not None:
            if reset:
                self._client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, RESET_ON_CLOSE)
            self._loop.forget(self._client)
            self._client.close()
            self._client = None
        self._scanner.hang_up()
        self._streaming.clear()

    def _forget_registration(self) -> None:
        self._scanner.streaming = False
        self._streaming.clear()

    def _listen(self) -> None:
        if self._listener is None:
            self._listener = socket.create_server(self.address)
            self._loop.watch(self._listener, self._accept)

    def _stop_listening(self) -> None:
        self._hang_up(True)
        self._close_listener()

    def _close_listener(self) -> None:
        if self._listener is not None:
            self._loop.forget(self._listener)
            self._listener.close()
            self._listener = None

    def _power_off(self, off_s: float) -> None:
        self._silent = True
        self._close_listener()
        self._loop.at(time.monotonic_ns() + int(off_s * 1e9), self._power_on)

    def _power_on(self) -> None:
        self._hang_up(True)
        self._scanner.power_up(time.monotonic_ns())
        self._silent = False
        self._listen()
