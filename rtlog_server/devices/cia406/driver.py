"""CiA 406 encoders on one CAN bus: configured over SDO, read by PDO just before each tick.

In: the bus and its encoders from the profile. Out: an `EncoderReading` a tick.

    bring up    identity → pre-operational → what differs is written (`configuration.py`) → operational
    each tick   SYNC → positions → reading (`rounds.py`), or the newest of those that come by timer
    all along   heartbeat, boot-up, emergency → who is alive, who is to be brought up again (`nodes.py`)

One thread does all of it: whatever it waits for, an SDO answer or the next tick, it goes on serving the bus. So an
encoder that is brought up, or is away, costs the others nothing.
"""

import time
from collections.abc import Callable, Mapping, Sequence

from hw_profiles.profile import CanBus, Encoder
from rtlog_server.devices.cia406 import protocol
from rtlog_server.devices.cia406.configuration import configure, identify
from rtlog_server.devices.cia406.nodes import Node, Nodes
from rtlog_server.devices.cia406.port import CanPort
from rtlog_server.devices.cia406.protocol import CanOpenError
from rtlog_server.devices.cia406.rounds import SyncRounds, TimerRounds
from rtlog_server.devices.cia406.sdo import NodeObjects, NodeSilentError
from rtlog_server.devices.device import DeviceError
from rtlog_server.devices.encoders import EncoderDevice, Fix, ReadingMaker

SERVICES = (protocol.EMCY, *protocol.TPDO.values(), protocol.SDO_REPLY, protocol.HEARTBEAT)
READ_NS = 200_000_000  # how long `read` serves the bus
TALLIED = ("restarts", "missed", "emergencies", "doubtful turns", "garbled")


class Cia406Encoders(EncoderDevice):
    """All CiA 406 encoders of the bus.

    An encoder that does not answer, or is not what the profile says, is left out of the readings, named in `message`,
    and brought up when it is back.
    """

    def __init__(self, name: str, bus: CanBus, encoders: Sequence[Encoder]) -> None:
        super().__init__(name)
        self._bus = bus
        self._nodes = Nodes(encoders)
        self._maker = ReadingMaker(encoders, {encoder.name: encoder.counts_per_turn for encoder in encoders})
        self._port: CanPort | None = None

    def connect(self) -> None:
        self._port = CanPort(self._bus, [service + node for service in SERVICES for node in self._nodes.addresses])
        for node in self._nodes:
            self._bring_up(node)
        self._require_one()
        self._nodes.rounds = self._open_rounds()
        for node in self._nodes:
            if node.running:
                self._nodes.rounds.join(node.name)

    def read(self) -> None:
        self._tell_health()
        self._serve(time.monotonic_ns() + READ_NS, until=lambda: self._nodes.due(time.monotonic_ns()) is not None)
        if (node := self._nodes.due(time.monotonic_ns())) is not None:
            self._bring_up(node)
        self._require_one()

    def disconnect(self) -> None:
        self._nodes.rounds = None
        for node in self._nodes:
            node.settings = None
        if self._port is not None:
            self._port.close()
            self._port = None

    def _open_rounds(self) -> SyncRounds | TimerRounds:
        assert self.grid is not None  # set by start()
        position_wire_ns = protocol.wire_ns(8, self._bus.bitrate)
        if self._bus.trigger == "timer":
            return TimerRounds(self.grid, position_wire_ns, self._bus.timer_ms * 1_000_000)
        sync_wire_ns = protocol.wire_ns(0, self._bus.bitrate)
        return SyncRounds(self.grid, sync_wire_ns, len(self._nodes.addresses) * position_wire_ns)

    def _require_one(self) -> None:
        if not self._nodes.any_running:
            raise DeviceError(f"{self._bus.place}: {self._nodes.problems()}")

    def _bring_up(self, node: Node) -> None:
        """Configure the node and start it; what is wrong with it is told in its `problem`. Raises: DeviceError."""
        port = self._opened()
        objects = NodeObjects(node.address, port.send, self._await_reply)
        pre_operational = protocol.nmt_command(protocol.ENTER_PRE_OPERATIONAL, node.address)
        if node.running:  # so it is ours, and if somebody stopped it, it answers only after this
            port.send(pre_operational)
        node.begin()
        try:
            self.identity[node.name] = identify(objects, node.address, self._bus)
            port.send(pre_operational)
            settings = configure(objects, node.address, node.encoder, self._bus)
        except NodeSilentError as error:
            node.problem = str(error)
            port.send(pre_operational)  # one that was stopped answers after this
        except CanOpenError as error:
            node.problem = str(error)
        else:
            port.send(protocol.nmt_command(protocol.START, node.address))
            self._maker.set_modulus(node.name, settings.total_range)
            node.run(settings, time.monotonic_ns())
            if self._nodes.rounds is not None:
                self._nodes.rounds.join(node.name)
        node.sought_ns = time.monotonic_ns()

    def _await_reply(self, node: int, deadline_ns: int) -> bytes | None:
        """What `sdo.py` waits by: the node's next SDO reply; None: there was none."""
        nodes = self._nodes
        nodes.sdo_reply = None
        self._serve(deadline_ns, until=lambda: nodes.sdo_reply is not None and nodes.sdo_reply.node == node)
        reply = nodes.sdo_reply
        return reply.data if reply is not None and reply.node == node else None

    def _serve(self, end_ns: int, until: Callable[[], bool]) -> None:
        """Receive, and keep the rounds going, until the time is over or something has come about."""
        port, nodes = self._opened(), self._nodes
        while not until() and not self._stopping.is_set() and (now_ns := time.monotonic_ns()) < end_ns:
            wake_ns = end_ns if nodes.rounds is None else min(end_ns, nodes.rounds.next_ns(now_ns))
            if nodes.rounds is not None and wake_ns <= now_ns:
                fixes = nodes.rounds.step(now_ns)
                if fixes is None:
                    nodes.rounds.sent(port.send(protocol.SYNC_FRAME))
                else:
                    self._finish_round(fixes)
                continue
            received = port.receive((wake_ns - now_ns) * 1e-9)
            if received is not None and (fixes := nodes.take(*received)) is not None:
                self._finish_round(fixes)

    def _finish_round(self, fixes: Mapping[str, Fix]) -> None:
        self._nodes.finish_round(fixes)
        if fixes:
            reading = self._maker.reading(fixes)
            self._nodes.tally["doubtful turns"] += len(reading.doubtful)
            self.hand_over(reading)

    def _tell_health(self) -> None:
        nodes, port = self._nodes, self._opened()
        told = [nodes.problems(), *(f"{node.name}: {node.health}" for node in nodes if node.emergency is not None)]
        if nodes.rounds is not None and nodes.rounds.answered_twice:
            told.append(f"{', '.join(sorted(nodes.rounds.answered_twice))}: two nodes answer to its id")
            nodes.rounds.answered_twice.clear()
        self.message = "; ".join(filter(None, told)) or "connected"
        self.diagnostics = {
            **{node.name: node.health for node in nodes},
            **{event: str(nodes.tally[event]) for event in TALLIED},
            "last garbled": nodes.last_garbled,
            "noise": str(port.garbled),
            "controller": port.controller,
        }

    def _opened(self) -> CanPort:
        assert self._port is not None  # connect() opened it
        return self._port
