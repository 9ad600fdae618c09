"""What an emulated reader pushes: a connection to the address that it was given, kept while there is use for it.

In: an address, data, and how long an idle connection stays open. Out: the data there, in order.
"""

import contextlib
import select
import socket
import time
from collections.abc import Callable

Connect = Callable[[tuple[str, int], float], socket.socket]  # address, time limit in s → connection
Send = Callable[[Callable[[bytes], None], bytes], None]  # how the wire sends, data

CONNECT_S = 1.0
RETRY_S = 0.3


class Push:
    """A tag stream, or a notification's connection.

    Args:
        send: puts data on the wire, given the wire's own way to send.
        greeting: what a new connection begins with.
    """

    def __init__(self, connect: Connect, send: Send, greeting: Callable[[socket.socket], bytes]) -> None:
        self._connect = connect
        self._send = send
        self._greeting = greeting
        self._socket: socket.socket | None = None
        self._opened_for: tuple[str, int] | None = None  # one that idled out is opened again for data only
        self._sent_s = 0.0
        self._retry_s = 0.0

    def serve(self, address: tuple[str, int] | None, data: bytes, idle_s: int, eager: bool) -> bool:
        """Send `data`, connecting if need be; whether it was sent. `eager` connects also without data, once."""
        now = time.monotonic()
        gone = self._socket is not None and (address != self._opened_for or hung_up(self._socket))
        if gone or now - self._sent_s > idle_s:
            self.close()
        if address is None:
            self._opened_for = None
            return False
        if self._socket is None and (data or (eager and address != self._opened_for)) and now >= self._retry_s:
            self._open(address)
        if self._socket is None or not data:
            return False
        self._sent_s = now
        try:
            self._send(self._socket.sendall, data)
        except OSError:
            self.close()
            return False
        return True

    def close(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _open(self, address: tuple[str, int]) -> None:
        try:
            self._socket = self._connect(address, CONNECT_S)
            self._socket.settimeout(CONNECT_S)
        except OSError:
            self._retry_s = time.monotonic() + RETRY_S
            return
        self._opened_for, self._sent_s = address, time.monotonic()
        with contextlib.suppress(OSError):  # the next look finds it hung up
            self._socket.sendall(self._greeting(self._socket))


def hung_up(connection: socket.socket) -> bool:
    """Whether the other side closed the connection; it never sends anything."""
    try:
        return bool(select.select([connection], [], [], 0)[0]) and not connection.recv(4096)
    except OSError:
        return True
