"""The device's end of an LMS111, as a TCP server in a thread of its own.

In: sweeps from outside, each with the host time of its first ray. Out: what a scanner sends. The law: to a client it is
a scanner. It serves one client at a time, streams only to one that asked for it, sends no sweep before its last ray.

    send_scan, faults ──> queue ──> the thread, which owns all state ──> sockets

Its faults are those of the field: a cable pulled, a connection cut, a port that refuses, a power cycle, bytes that are
no telegram.
"""

import heapq
import itertools
import queue
import selectors
import socket
import struct
import threading
import time
from collections.abc import Callable
from typing import Any, Self

from numpy.typing import ArrayLike

from rtlog_server.devices.lms111.cola import ColaError, Dialect, Receiver
from rtlog_server.devices.lms111.emulated_scanner import EmulatedScanner, Sweep, make_sweep
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
        serial_no, clock_offset_us, clock_drift_ppm, start_s: as in `EmulatedScanner`.

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
    ) -> None:
        now_ns = time.monotonic_ns()
        self._scanner = EmulatedScanner(now_ns, serial_no, dialect == "B", clock_offset_us, clock_drift_ppm, start_s)
        self._listener: socket.socket | None = socket.create_server((host, port))
        self.address: tuple[str, int] = self._listener.getsockname()[:2]
        self._client: socket.socket | None = None
        self._dialect = Dialect.B
        self._receiver = Receiver(self._dialect)
        self._silent = False
        self._streaming = threading.Event()
        self._tasks: queue.SimpleQueue[tuple[Callable[..., None], tuple[Any, ...], threading.Event]] = (
            queue.SimpleQueue()
        )
        self._timers: list[tuple[int, int, Callable[..., None], tuple[Any, ...]]] = []
        self._order = itertools.count()
        self._selector = selectors.DefaultSelector()
        self._wake, self._waker = socket.socketpair()
        self._selector.register(self._wake, selectors.EVENT_READ, self._run_tasks)
        self._selector.register(self._listener, selectors.EVENT_READ, self._accept)
        self._closing = False
        self._thread = threading.Thread(target=self._run, name="lms111 emulator", daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        if not self._closing:
            self._call(self._close)
            self._thread.join()

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
    ) -> None:
        """Measure and send a sweep; returns at once, the scan goes out after its last ray.

        Args:
            ranges_m: (N,) +inf: no return, NaN: rejected; sent in whole millimetres.
            first_ray_ns: when the first ray was measured (monotonic).
            angle_min_rad: of the first ray, in the scanner's frame.
            angle_increment_rad: above 0, up to 6.5°.
            intensities: (N,) sent if the client asked for remission; None or empty: there are none.

        Raises:
            ValueError: no scanner can measure such a sweep.
        """
        sweep = make_sweep(ranges_m, first_ray_ns, angle_min_rad, angle_increment_rad, intensities)
        self._post(self._measure, sweep)

    def send_raw(self, data: bytes) -> None:
        """Put any bytes on the wire."""
        self._call(self._send, data)

    def set_status(self, status: int) -> None:
        """The device status of the scans from now on: 1 error, 2 contamination warning, 4 contamination error."""
        self._call(setattr, self._scanner, "device_status", (0, status))

    def set_temperature(self, outside: bool) -> None:
        """Whether it is outside of its temperature range."""
        self._call(setattr, self._scanner, "outside_temperature", outside)

    def drop_connection(self) -> None:
        """Reset the client's connection."""
        self._call(self._hang_up, True)

    def go_silent(self, silent: bool = True) -> None:
        """Say nothing more, as if the cable were pulled; new connections are taken and met with silence."""
        self._call(setattr, self, "_silent", silent)

    def refuse(self, refusing: bool = True) -> None:
        """Reset the connection and refuse new ones; or take them again."""
        self._call(self._stop_listening if refusing else self._listen)

    def power_cycle(self, off_s: float = 0.5) -> None:
        """Lose power without a word; back with counters, clock and configuration as after any power-up."""
        self._call(self._power_off, off_s)

    # In the thread

    def _run(self) -> None:
        while not self._closing:
            wait_s = None
            if self._timers:
                wait_s = max(0.0, (self._timers[0][0] - time.monotonic_ns()) * 1e-9)
            for key, _ in self._selector.select(wait_s):
                key.data()
            while self._timers and self._timers[0][0] <= time.monotonic_ns():
                _, _, function, arguments = heapq.heappop(self._timers)
                function(*arguments)

    def _post(self, function: Callable[..., None], *arguments: Any) -> threading.Event:
        done = threading.Event()
        self._tasks.put((function, arguments, done))
        self._waker.send(b"\0")
        return done

    def _call(self, function: Callable[..., None], *arguments: Any) -> None:
        """Have the thread do it, and wait until it is done."""
        self._post(function, *arguments).wait()

    def _run_tasks(self) -> None:
        self._wake.recv(4096)
        while not self._tasks.empty():
            function, arguments, done = self._tasks.get()
            function(*arguments)
            done.set()

    def _at(self, due_ns: int, function: Callable[..., None], *arguments: Any) -> None:
        heapq.heappush(self._timers, (due_ns, next(self._order), function, arguments))

    def _measure(self, sweep: Sweep) -> None:
        self._at(self._scanner.last_ray_ns(sweep) + READY_AFTER_NS, self._transmit, sweep)

    def _transmit(self, sweep: Sweep) -> None:
        now_ns = time.monotonic_ns()
        if self._scanner.streaming and self._scanner.state(now_ns) == MEASURING and not self._silent:
            self._send(encode_scan_data(self._dialect, self._scanner.scan_data(sweep, now_ns)))

    def _accept(self) -> None:
        assert self._listener is not None
        connection, _ = self._listener.accept()
        if self._client is not None:
            self._receive()  # it may have hung up
        if self._client is not None:
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, RESET_ON_CLOSE)
            connection.close()
            return
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._client = connection
        self._dialect = Dialect.B if self._scanner.speaks_cola_b else Dialect.A
        self._receiver = Receiver(self._dialect)
        self._selector.register(connection, selectors.EVENT_READ, self._receive)

    def _receive(self) -> None:
        if self._client is None:
            return  # it went while an earlier event was handled
        try:
            data = self._client.recv(65536)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self._hang_up(False)
        elif not self._silent:
            for payload in self._receiver.feed(data):
                self._send(self._answer(payload))

    def _answer(self, payload: bytes) -> bytes:
        try:
            command = decode(self._dialect, payload)
        except ColaError:
            command = None
        if command is None or isinstance(command, ScanData) or command.name[:3] not in REPLY_VERBS:
            return encode_command(self._dialect, "sFA", INVALID_DATA)
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
            self._selector.unregister(self._client)
            self._client.close()
            self._client = None
        self._scanner.hang_up()
        self._streaming.clear()

    def _listen(self) -> None:
        if self._listener is None:
            self._listener = socket.create_server(self.address)
            self._selector.register(self._listener, selectors.EVENT_READ, self._accept)

    def _stop_listening(self) -> None:
        self._hang_up(True)
        self._close_listener()

    def _close_listener(self) -> None:
        if self._listener is not None:
            self._selector.unregister(self._listener)
            self._listener.close()
            self._listener = None

    def _power_off(self, off_s: float) -> None:
        self._silent = True
        self._close_listener()
        self._at(time.monotonic_ns() + int(off_s * 1e9), self._power_on)

    def _power_on(self) -> None:
        self._hang_up(True)
        self._scanner.power_up(time.monotonic_ns())
        self._silent = False
        self._listen()

    def _close(self) -> None:
        self._closing = True
        self._stop_listening()
        for end in (self._wake, self._waker):
            end.close()
        self._selector.close()
