"""The two wires to a reader's console: a TCP connection, or a serial line.

In: where the reader is. Out: bytes, both ways. Every way in which a wire can fail comes out as one DeviceError.
"""

import contextlib
import os
import select
import socket
import time

from hw_profiles.profile import RfidDevice
from rtlog_server.devices.device import DeviceError
from rtlog_server.devices.serial_port import LOST, open_serial_port

CONNECT_S = 0.5  # a reader answers within milliseconds; one that comes back is not to wait for a lost packet's sequel
RECEIVE_BYTES = 4096  # at once; who sends as much is read slowly:
FLOOD_PAUSE_S = 0.005  # 0.8 MB/s, a hundred times what a reader sends


def slowly(data: bytes) -> bytes:
    """The same; after a full read it takes its time, so that a flood neither fills memory nor takes the processor."""
    if len(data) == RECEIVE_BYTES:
        time.sleep(FLOOD_PAUSE_S)
    return data


class TcpLink:
    """A connection to the reader. Raises, here and in its methods: DeviceError."""

    needs_login = True

    def __init__(self, host: str, port: int) -> None:
        self.where = f"{host}:{port}"
        try:
            self._socket = socket.create_connection((host, port), CONNECT_S)
        except OSError as error:
            raise DeviceError(f"{self.where}: no connection: {error.strerror or error}") from error
        self.family = self._socket.family
        self.our_host = str(self._socket.getsockname()[0])
        self.reader_host = str(self._socket.getpeername()[0])

    def fileno(self) -> int:
        return self._socket.fileno()

    def send(self, data: bytes) -> None:
        try:
            self._socket.sendall(data)
        except OSError as error:
            raise self._lost(error) from error

    def receive(self, timeout_s: float) -> bytes | None:
        """What came; None: nothing in that time; empty: the reader hung up."""
        self._socket.settimeout(max(timeout_s, 1e-3))
        try:
            return slowly(self._socket.recv(RECEIVE_BYTES))
        except TimeoutError:
            return None
        except OSError as error:
            raise self._lost(error) from error

    def close(self) -> None:
        self._socket.close()

    def _lost(self, error: OSError) -> DeviceError:
        return DeviceError(f"{self.where}: lost the connection: {error.strerror or error}")


class SerialLink:
    """The reader's RS-232 port, 8N1, no login. Raises, here and in its methods: DeviceError."""

    needs_login = False
    family = socket.AF_INET
    our_host = ""  # no address of ours that the reader could call
    reader_host = ""  # it may be anyone who calls

    def __init__(self, port: str, baud: int) -> None:
        self.where = port
        self._serial = open_serial_port(port, baud, read_timeout_s=0.0)

    def fileno(self) -> int:
        return int(self._serial.fileno())

    def send(self, data: bytes) -> None:
        try:
            self._serial.write(data)
        except LOST as error:
            raise DeviceError(f"{self.where}: lost the port: {error}") from error

    def receive(self, timeout_s: float) -> bytes | None:
        """What came; None: nothing in that time."""
        try:
            if not select.select([self._serial], [], [], timeout_s)[0]:
                return None
            data = os.read(self._serial.fileno(), RECEIVE_BYTES)
        except LOST as error:
            raise DeviceError(f"{self.where}: lost the port: {error}") from error
        if not data:
            raise DeviceError(f"{self.where}: lost the port: its adapter is gone")
        return slowly(data)

    def close(self) -> None:
        with contextlib.suppress(*LOST):
            self._serial.close()


Link = TcpLink | SerialLink


def open_link(settings: RfidDevice) -> Link:
    """The wire that the profile names. Raises: DeviceError."""
    if settings.serial_port:
        return SerialLink(settings.serial_port, settings.baud)
    return TcpLink(settings.host, settings.port)
