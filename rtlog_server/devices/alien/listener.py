"""Where the reader pushes to: a port of ours, and the connections that it opens to it.

    reader ── tag stream: one connection, a line a read ───────────────┐
    reader ── notify: a connection for each message, or one for many ──┴──> lines

In: connections from the reader's address. Out: their lines. The law: whoever connects, however many and whatever they
send, costs a few sockets and a few kilobytes.
"""

import selectors
import socket
from collections import Counter

from rtlog_server.devices.alien import protocol
from rtlog_server.devices.alien.link import RECEIVE_BYTES, slowly
from rtlog_server.devices.alien.protocol import AlienError, Splitter
from rtlog_server.devices.device import DeviceError

MAX_CONNECTIONS = 4  # the newest; a reader has one or two


class PushListener:
    """A listening port, watched by `selector`.

    Args:
        host: the address to listen at, "" for any.
        port: 0 for any.
        reader_host: who may connect, "" for anyone.

    Raises: DeviceError: the port is taken or forbidden.
    """

    def __init__(
        self, host: str, port: int, family: socket.AddressFamily, reader_host: str, selector: selectors.BaseSelector
    ) -> None:
        try:
            self._listener = socket.create_server((host, port), family=family)
        except OSError as error:
            raise DeviceError(f"stream_port {port}: cannot listen: {error.strerror}") from error
        self._listener.setblocking(False)
        self._reader_host = reader_host
        self._selector = selector
        self._selector.register(self._listener, selectors.EVENT_READ)
        self._connections: dict[socket.socket, Splitter] = {}  # the oldest first
        self.port = int(self._listener.getsockname()[1])
        self.tally: Counter[str] = Counter()
        self.last_garbled = ""

    @property
    def is_open(self) -> bool:
        """Whether the reader has a connection to us."""
        return bool(self._connections)

    def receive(self, ready: socket.socket) -> list[str]:
        """Accept or read what `selector` found ready; the lines that are complete now. Sockets of others: none."""
        if ready is self._listener:
            self._accept()
            return []
        return self._read(ready) if ready in self._connections else []

    def drop_all(self) -> None:
        """Close the reader's connections; it may open others."""
        for connection in list(self._connections):
            self._drop(connection)

    def close(self) -> None:
        self.drop_all()
        self._selector.unregister(self._listener)
        self._listener.close()

    def _accept(self) -> None:
        try:
            connection, (peer, *_) = self._listener.accept()
        except (BlockingIOError, ConnectionError):
            return  # gone again
        if self._reader_host not in ("", peer):
            self.tally["strangers refused"] += 1
            connection.close()
            return
        if len(self._connections) == MAX_CONNECTIONS:
            self._drop(next(iter(self._connections)))
        connection.setblocking(False)
        self._selector.register(connection, selectors.EVENT_READ)
        self._connections[connection] = protocol.line_splitter()
        self.tally["streams"] += 1

    def _read(self, connection: socket.socket) -> list[str]:
        try:
            data = slowly(connection.recv(RECEIVE_BYTES))
            lines = self._connections[connection].feed(data)
        except BlockingIOError:
            return []
        except (OSError, AlienError) as error:
            self.last_garbled = str(error)
            self._drop(connection)
            return []
        if not data:
            self._drop(connection)
        return lines

    def _drop(self, connection: socket.socket) -> None:
        del self._connections[connection]
        self._selector.unregister(connection)
        connection.close()
