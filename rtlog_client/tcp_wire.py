"""A wire of TCP: hosts connect to the device through it, and a device that calls its host back does too.

A cut holds what TCP would send again later, and resets at its end the connections that were tried meanwhile. In a
restart everything is reset and refused. A swap resets all connections; new ones lead to the other device.
"""

import contextlib
import socket
import struct
from collections.abc import Callable

from rtlog_client.faults import Fault
from rtlog_client.wire import READ_BYTES, Flow, Wire

RESET_ON_CLOSE = struct.pack("ii", 1, 0)  # SO_LINGER
PATIENCE_S = 1.0  # with an end that does not take what it is sent
Address = tuple[str, int]


class _Link:
    """Two connections that are one: `ends` by where the bytes of a flow come from."""

    def __init__(self, host: socket.socket, device: socket.socket) -> None:
        for end in (host, device):
            end.settimeout(PATIENCE_S)
            end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.ends = {host: Flow(_sender(device), False), device: Flow(_sender(host), True)}


def _sender(end: socket.socket) -> Callable[[bytes], None]:
    def send(data: bytes) -> None:
        if data:
            end.sendall(data)
        else:
            end.shutdown(socket.SHUT_WR)

    return send


def reset(connection: socket.socket) -> None:
    with contextlib.suppress(OSError):
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, RESET_ON_CLOSE)
    connection.close()


class TcpWire(Wire):
    """Between `address`, where hosts connect to (port 0: any), and `device`, where the device listens."""

    def __init__(self, name: str, address: Address, seed: int = 0) -> None:
        super().__init__(name, seed)
        self.device: Address = ("", 0)  # to be set before the first host comes
        self._crossed: Address | None = None
        self.address = address
        self._outward: dict[Address, socket.socket] = {}  # where a host listens: where its device connects to instead
        self._links: list[_Link] = []

    def dial(self, address: Address, timeout: float) -> socket.socket:
        """Connect as the device, through the wire, to a host that listens at `address`. Raises: OSError."""
        self._call(lambda: self._open_outward(address))
        return socket.create_connection(self._outward[address].getsockname(), timeout)

    def cross(self, other: "TcpWire") -> None:
        """In a swap: new connections lead to the device of another wire until the fault ends."""
        self._call(lambda: setattr(self, "_crossed", other.device))

    # In the thread

    def _open(self) -> None:
        self._listener = socket.create_server(self.address)
        self.address = self._listener.getsockname()[:2]
        self._watch(self._listener, self._accept)

    def _begin(self, fault: Fault) -> None:
        self.fault = fault
        if fault.kind == "cut":
            for end in self._all_ends():
                self._ignore(end)
        elif fault.kind == "restart":
            self._reset_all()
            self._ignore(self._listener)
            self._listener.close()
        elif fault.kind == "swap":
            self._reset_all()

    def _end(self) -> None:
        fault, self.fault = self.fault, None
        if fault is None:
            return
        if fault.kind == "cut":
            self._resume()
        elif fault.kind == "restart":
            self._open()
        elif fault.kind == "swap":
            self._crossed = None
            self._reset_all()

    def _all_ends(self) -> list[socket.socket]:
        return [self._listener, *self._outward.values(), *(end for link in self._links for end in link.ends)]

    def _resume(self) -> None:
        for listener in (self._listener, *self._outward.values()):
            listener.setblocking(False)
            with contextlib.suppress(BlockingIOError):
                while True:  # with the cable out, these would not have come about
                    reset(listener.accept()[0])
        self._watch(self._listener, self._accept)
        for address, listener in self._outward.items():
            self._watch(listener, self._acceptor(address, listener))
        for link in self._links:
            self._watch_link(link)

    def _accept(self) -> None:
        host, _ = self._listener.accept()
        try:
            device = socket.create_connection(self._crossed or self.device, PATIENCE_S)
        except OSError:  # as if the host had tried it itself, a moment later
            reset(host)
            return
        self._join(_Link(host, device))

    def _open_outward(self, address: Address) -> None:
        if address not in self._outward:
            listener = self._outward[address] = socket.create_server(("127.0.0.1", 0))
            if self.fault is None or self.fault.kind != "cut":
                self._watch(listener, self._acceptor(address, listener))

    def _acceptor(self, address: Address, listener: socket.socket) -> Callable[[], None]:
        def accept() -> None:
            device, _ = listener.accept()
            try:
                host = socket.create_connection(address, PATIENCE_S, source_address=(self.address[0], 0))
            except OSError:
                reset(device)
                return
            self._join(_Link(host, device))

        return accept

    def _join(self, link: _Link) -> None:
        self._links.append(link)
        self._watch_link(link)

    def _watch_link(self, link: _Link) -> None:
        for end, flow in link.ends.items():
            if not flow.ended:
                self._watch(end, self._receiver(link, end))

    def _receiver(self, link: _Link, end: socket.socket) -> Callable[[], None]:
        def receive() -> None:
            if link not in self._links:
                return  # it was reset while an earlier event was handled
            try:
                data = end.recv(READ_BYTES)
            except OSError:
                self._drop(link)
                return
            link.ends[end].put(data, self)
            if not data:
                self._ignore(end)

        return receive

    def _flush(self) -> float | None:
        if self.fault is not None and self.fault.kind == "cut":
            return None
        waits_s: list[float | None] = []
        for link in list(self._links):
            try:
                waits_s += [flow.flush() for flow in link.ends.values()]
            except OSError:
                self._drop(link)
                continue
            if all(flow.ended for flow in link.ends.values()):
                self._links.remove(link)
                for end in link.ends:
                    end.close()
        return min((wait_s for wait_s in waits_s if wait_s is not None), default=None)

    def _drop(self, link: _Link) -> None:
        self._links.remove(link)
        for end in link.ends:
            self._ignore(end)
            reset(end)

    def _reset_all(self) -> None:
        for link in list(self._links):
            self._drop(link)

    def _shut(self) -> None:
        self._reset_all()
        self._listener.close()
        for listener in self._outward.values():
            listener.close()
