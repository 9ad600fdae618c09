"""One TCP connection to a scanner: commands and their replies, and what it sends unasked.

    host     command ─────────────>       one at a time, each with a time limit
    device        <─ event, event, reply ─  told apart by name, never by order

In: commands, and the bytes of a socket. Out: the values of replies; events with the time of their reception. The law:
an error reply (sFA) does not say which command it answers, so after a command that was not answered the connection is
of no use any more and is closed, but by one who only asks. Every failure is a `DeviceError` that says where.
"""

import socket
import time
from collections import deque
from collections.abc import Callable
from typing import Any, Self

from rtlog_server.devices.device import DeviceError
from rtlog_server.devices.lms111.cola import ColaError, Dialect, Receiver
from rtlog_server.devices.lms111.protocol import ERRORS, Command, decode, encode_command, reply_name
from rtlog_server.devices.lms111.scan_data import ScanData

CONNECT_S = 0.5  # on one cable; a longer wait would miss a device that comes back
PROBE_S = 0.25
ANSWER_S = 0.5  # the captured device answers within 5 ms, and within 15 ms when it starts to measure
LONGEST_WAIT_S = 0.1  # to notice that nobody wants the answer any more
RECEIVE_BYTES = 65536
WAITING_TELEGRAMS = 1024
# In a second. A scanner sends 0.6 MB at most; what a host that stood still finds in its socket is some seconds more.
FLOOD_BYTES = 8_000_000

Event = tuple[Command | ScanData, int]  # and when it was received (monotonic ns)


class NoAnswerError(DeviceError):
    """The device did not answer a command in time."""


class RefusedError(DeviceError):
    """The device answered a command with an error."""


class Connection:
    """An open connection in one dialect. What cannot be decoded is counted and let pass.

    Args:
        host, port: of the device.
        dialect: in which to speak; whether the device speaks it shows with the first answer.
        stopped: says that nobody wants the answer any more.

    Raises:
        DeviceError: nobody takes the connection.
    """

    def __init__(self, host: str, port: int, dialect: Dialect, stopped: Callable[[], bool] = lambda: False) -> None:
        self.where = f"LMS111 at {host}:{port}"
        self.dialect = dialect
        self.bad_telegrams = 0
        self.last_bad = ""  # what was wrong with the last bad telegram
        self._stopped = stopped
        self._receiver = Receiver(dialect)
        self._payloads: deque[tuple[bytes, int]] = deque()
        self._events: deque[Event] = deque(maxlen=WAITING_TELEGRAMS)  # that came while a reply was awaited
        self._second_ends_ns = self._second_bytes = 0
        try:
            self._socket = socket.create_connection((host, port), CONNECT_S)
        except OSError as error:
            raise self._failed(error) from error
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self._socket.close()

    @property
    def skipped_bytes(self) -> int:
        """Bytes that belonged to no whole telegram."""
        return self._receiver.skipped_bytes

    def ask(self, command: str, *values: int, limit_s: float = ANSWER_S) -> tuple[Any, ...]:
        """The values of the reply to a command; events that come in between wait for `receive`.

        Raises:
            RefusedError: the device refuses the command.
            NoAnswerError: it does not answer.
            DeviceError: the connection broke.
        """
        try:
            self._socket.settimeout(limit_s)
            self._socket.sendall(encode_command(self.dialect, command, *values))
        except OSError as error:
            raise self._failed(error) from error
        deadline_ns = time.monotonic_ns() + int(limit_s * 1e9)
        while time.monotonic_ns() < deadline_ns and not self._stopped():
            event = self._next(deadline_ns)
            if event is None:
                continue
            telegram = event[0]
            if isinstance(telegram, ScanData):
                if command == "sRN LMDscandata":
                    return (telegram,)
                self._events.append(event)
            elif telegram.name == reply_name(command):
                return telegram.values
            elif telegram.name == "sFA":
                code = telegram.values[0]
                raise RefusedError(f"{self.where} refuses {command}: {ERRORS.get(code, 'unknown error')} (sFA {code})")
        raise NoAnswerError(f"{self.where}: no answer to {command}" + (f"; {self.last_bad}" if self.last_bad else ""))

    def receive(self, deadline_ns: int) -> Event | None:
        """The next event; None: none yet, or none by the deadline (monotonic ns).

        Raises:
            DeviceError: the connection broke, or the device floods it.
        """
        return self._events.popleft() if self._events else self._next(deadline_ns)

    def _next(self, deadline_ns: int) -> Event | None:
        if not self._payloads:
            self._fill(deadline_ns)
        if not self._payloads:
            return None
        payload, receive_ns = self._payloads.popleft()
        try:
            return decode(self.dialect, payload), receive_ns
        except ColaError as error:
            self.bad_telegrams += 1
            self.last_bad = str(error)
            return None

    def _fill(self, deadline_ns: int) -> None:
        """Wait for bytes, but not for long."""
        wait_s = (deadline_ns - time.monotonic_ns()) * 1e-9
        try:
            self._socket.settimeout(min(max(wait_s, 1e-3), LONGEST_WAIT_S))
            data = self._socket.recv(RECEIVE_BYTES)
        except TimeoutError:
            return
        except OSError as error:
            raise self._failed(error) from error
        receive_ns = time.monotonic_ns()
        if not data:
            raise DeviceError(f"{self.where} closed the connection")
        if receive_ns > self._second_ends_ns:
            self._second_ends_ns, self._second_bytes = receive_ns + 1_000_000_000, 0
        self._second_bytes += len(data)
        if self._second_bytes > FLOOD_BYTES:
            raise DeviceError(f"{self.where} floods: {self._second_bytes} bytes within a second")
        self._payloads.extend((payload, receive_ns) for payload in self._receiver.feed(data))

    def _failed(self, error: OSError) -> DeviceError:
        return DeviceError(f"{self.where}: {error.strerror or error}")


def open_connection(
    host: str, port: int, first: Dialect = Dialect.B, stopped: Callable[[], bool] = lambda: False
) -> Connection:
    """A connection on which the device answers: in the dialect `first`, or else in the other.

    A dialect that the port does not speak meets silence, so each is probed on a connection of its own.

    Raises:
        DeviceError: nobody takes the connection, or it is taken and meets silence in both dialects.
    """
    for dialect in (first, first.other):
        connection = Connection(host, port, dialect, stopped)
        try:
            connection.ask("sRN SCdevicestate", limit_s=PROBE_S)
        except NoAnswerError:
            connection.close()
        except RefusedError:  # an answer, too
            return connection
        except DeviceError:
            connection.close()
            raise
        else:
            return connection
    raise DeviceError(f"LMS111 at {host}:{port} takes connections but answers neither in CoLa A nor in CoLa B")
