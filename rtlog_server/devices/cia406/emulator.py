"""The encoders' end of a CAN bus: what a host meets behind its CAN interface.

In: the true position of every encoder as a function of time. Out: frames of the nodes, on whatever bus the profile
names: python-can's, or an slcan adapter on a pseudo-terminal. One thread serves all nodes.
"""

import time
from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path

from hw_profiles.profile import CanBus
from rtlog_server.devices.cia406 import protocol
from rtlog_server.devices.cia406.emulated_encoder import EmulatedEncoder
from rtlog_server.devices.cia406.port import CanPort
from rtlog_server.devices.cia406.protocol import Emergency, Frame
from rtlog_server.devices.cia406.slcan_adapter import SlcanAdapter
from rtlog_server.devices.device import DeviceError
from rtlog_server.devices.emulated_bus import WATCH_S, EmulatedBus


class CanBusEmulator(EmulatedBus):
    """Encoders on a bus, running from construction to `close()`; a context manager.

    Args:
        bus: as in the profile; the channel of slcan is the symbolic link to the adapter's terminal.
        encoders: node id → counts per turn.
        position: (node id, monotonic ns) → counts over many turns; called in the emulator's thread.

    Raises:
        DeviceError: the interface cannot be opened.
        OSError: the link of an slcan adapter cannot be made.
    """

    def __init__(self, bus: CanBus, encoders: Mapping[int, int], position: Callable[[int, int], int]) -> None:
        super().__init__(f"CAN emulator {bus.place}")
        self.bus = bus
        self.nodes = {
            node: EmulatedEncoder(node, counts_per_turn, lambda now_ns, node=node: position(node, now_ns))  # type: ignore[misc]
            for node, counts_per_turn in encoders.items()
        }
        self._wanted: deque[Callable[[], list[Frame]]] = deque()  # what other threads want done in ours
        self._port: CanPort | SlcanAdapter
        self.replug()

    # Faults, beside those of every bus

    def power_cycle(self, node: int) -> None:
        """The encoder loses its power for a moment: it boots, all configuration is lost."""
        self._wanted.append(lambda: self.nodes[node].power_up(time.monotonic_ns()))

    def emergency(self, node: int, code: int, register: int = 0x81, vendor: bytes = b"") -> None:
        """The encoder reports an error; code 0: it is gone."""
        self.send(protocol.encode_emergency(Emergency(node, code, register, vendor)))

    def adapter_noise(self, data: bytes) -> None:
        """The slcan adapter sends bytes that are none of its protocol."""

        def write() -> list[Frame]:
            assert isinstance(self._port, SlcanAdapter)
            self._port.write(data)
            return []

        self._wanted.append(write)

    def wait_until_done(self) -> None:
        """Until all that was asked for above is done."""
        while self._wanted:
            time.sleep(WATCH_S / 10)

    def send(self, frame: Frame) -> None:
        """Any frame, as of another device on the bus."""
        self._wanted.append(lambda: [frame])

    # The thread

    def _plug(self) -> None:
        """The encoders get their power with the bus."""
        slcan = self.bus.interface == "slcan"
        self._port = SlcanAdapter(Path(self.bus.channel)) if slcan else CanPort(self.bus)
        for node in self.nodes:
            self.power_cycle(node)

    def _pull(self) -> None:
        self._port.close()

    def _serve(self) -> None:
        while not self._unplugged.is_set():
            frames: list[Frame] = []
            while self._wanted:
                frames += self._wanted[0]()
                self._wanted.popleft()  # now that it is done: `wait_until_done` looks at this
            now_ns = time.monotonic_ns()
            present = [encoder for node, encoder in self.nodes.items() if node not in self._muted]
            for encoder in present:
                if encoder.due_ns() <= now_ns:
                    frames += encoder.tick(now_ns)
            self._send(frames)
            due_ns = min((encoder.due_ns() for encoder in present), default=now_ns + 10**9)
            received = self._receive(min(WATCH_S, max(0.0, (due_ns - now_ns) * 1e-9)))
            if received is not None:
                frame, arrived_ns = received
                self._send([answer for encoder in present for answer in encoder.take(frame, arrived_ns)])

    def _receive(self, timeout_s: float) -> tuple[Frame, int] | None:
        try:
            return self._port.receive(timeout_s)
        except DeviceError:  # a fault of the bus: a node waits until it is over
            self._unplugged.wait(WATCH_S)
            return None

    def _send(self, frames: list[Frame]) -> None:
        for frame in frames:
            if protocol.node_of(frame) not in self._muted:
                try:
                    self._port.send(frame)
                except DeviceError:  # nobody listens: a node does not care
                    return
