"""A wire of a CAN bus on UDP multicast: two ports of one group, the host's and the emulator's, and frames between them.

A frame that noise has hit fails its checksum on a real bus, and is lost here too. In a cut and in a restart nothing
passes.
"""

import struct
from collections import deque
from collections.abc import Callable
from contextlib import suppress

from msgspec.structs import replace

from hw_profiles.profile import CanBus
from rtlog_client.faults import Fault
from rtlog_client.wire import Flow, Wire
from rtlog_server.devices.cia406.port import CanPort
from rtlog_server.devices.cia406.protocol import Frame
from rtlog_server.devices.device import DeviceError

HEAD = struct.Struct("<H")  # the identifier, before the data
MOST_SENT = 256  # frames that a port may be still to hear of its own


class CanWire(Wire):
    """Between the host's `bus` and the port `device_port` of the same group, where the nodes are."""

    def __init__(self, name: str, bus: CanBus, device_port: int, seed: int = 0) -> None:
        super().__init__(name, seed)
        self._buses = bus, replace(bus, udp_port=device_port)

    # In the thread

    def _open(self) -> None:
        self._host, self._device = map(CanPort, self._buses)
        self._sent: dict[CanPort, deque[bytes]] = {port: deque(maxlen=MOST_SENT) for port in (self._host, self._device)}
        self._to_device = Flow(self._sender(self._device), False)
        self._to_host = Flow(self._sender(self._host), True)
        self._watch(self._host, lambda: self._take(self._host, self._to_device))
        self._watch(self._device, lambda: self._take(self._device, self._to_host))

    def _begin(self, fault: Fault) -> None:
        self.fault = fault

    def _end(self) -> None:
        self.fault = None

    def bend(self, data: bytes) -> bytes:
        bent = super().bend(data)
        return bent if bent == data else b""

    def _take(self, port: CanPort, flow: Flow) -> None:
        received = port.receive(0.0)
        if received is None:
            return
        data = HEAD.pack(received[0].can_id) + received[0].data
        if data in self._sent[port]:  # multicast brings back what we sent: it must not go round for ever
            self._sent[port].remove(data)
        elif not (self.fault is not None and self.fault.kind in ("cut", "restart")):
            flow.put(data, self)

    def _sender(self, port: CanPort) -> Callable[[bytes], None]:
        def send(data: bytes) -> None:
            with suppress(DeviceError):  # nobody listens: a bus does not care
                port.send(Frame(HEAD.unpack_from(data)[0], data[HEAD.size :]))
                self._sent[port].append(data)

        return send

    def _flush(self) -> float | None:
        waits_s = [self._to_device.flush(), self._to_host.flush()]
        return min((wait_s for wait_s in waits_s if wait_s is not None), default=None)

    def _shut(self) -> None:
        for port in (self._host, self._device):
            self._ignore(port)
            port.close()
