"""CiA 406 encoders on one CAN bus: configured over SDO, read by PDO just before each tick.

In: the bus and its encoders from the profile. Out: an `EncoderReading` a tick.

    bring up    pre-operational → identity, configuration (`configuration.py`) → operational
    each tick   SYNC → positions → reading (`rounds.py`), or the newest of those that come by timer
    all along   heartbeat, boot-up, emergency → who is alive, who must be brought up anew, what is wrong with it

One thread does all of it: whatever it waits for, an SDO answer or the next tick, it goes on serving the bus. So an
encoder that is brought up, or is away, costs the others nothing.
"""

import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from hw_profiles.profile import CanBus, Encoder
from rtlog_server.devices.cia406 import protocol
from rtlog_server.devices.cia406.configuration import HEARTBEAT_MS, NodeSettings, configure, identify
from rtlog_server.devices.cia406.port import CanPort
from rtlog_server.devices.cia406.protocol import CanOpenError, Emergency, Frame, Heartbeat, Pdo, SdoReply
from rtlog_server.devices.cia406.rounds import SyncRounds, TimerRounds
from rtlog_server.devices.cia406.sdo import NodeObjects, NodeSilentError
from rtlog_server.devices.device import Device, DeviceError, TickGrid
from rtlog_server.devices.encoders import EncoderReading, Fix, ReadingMaker

LOST_NS = 5 * HEARTBEAT_MS * 1_000_000 // 2  # without any frame from a node
SETTLING_NS = 2 * HEARTBEAT_MS * 1_000_000  # after the start command, in which old heartbeats still come
MISSED_ROUNDS = 8  # of a node that is alive: its PDO was configured away
SEEK_NS = 500_000_000  # a node that is away is asked for this often; one that boots says so itself
READ_S = 0.2  # how long `read` serves the bus


@dataclass(slots=True)
class Node:
    """An encoder on the bus as the driver knows it."""

    encoder: Encoder
    address: int
    settings: NodeSettings | None = None  # None: not running
    problem: str = "not asked yet"
    booted: bool = False  # said so, and was not brought up since
    heard_ns: int = 0
    started_ns: int = 0
    sought_ns: int = 0
    missed: int = 0  # rounds in succession
    emergency: Emergency | None = None

    @property
    def running(self) -> bool:
        return self.settings is not None


class Cia406Encoders(Device[EncoderReading]):
    """All CiA 406 encoders of the bus.

    An encoder that does not answer, or is not what the profile says, is left out of the readings, named in `message`,
    and brought up when it is back.
    """

    def __init__(self, name: str, bus: CanBus, encoders: Sequence[Encoder]) -> None:
        super().__init__(name, stale_after_s=0.35)
        self._bus = bus
        # A profile with a bus was checked to hold every address.
        self._nodes = {encoder.address or 0: Node(encoder, encoder.address or 0) for encoder in encoders}
        self._maker = ReadingMaker(encoders, {encoder.name: encoder.counts_per_turn for encoder in encoders})
        self._port: CanPort | None = None
        self._rounds: SyncRounds | TimerRounds | None = None  # None: the encoders are not started yet
        self._sdo_reply: SdoReply | None = None
        self._tally: Counter[str] = Counter()
        self._last_garbled = "none"

    def start(self, grid: TickGrid) -> None:
        self._stale_after_ns = max(self._stale_after_ns, 3 * grid.period_ns)
        super().start(grid)

    def connect(self) -> None:
        services = (protocol.EMCY, *protocol.TPDO.values(), protocol.SDO_REPLY, protocol.HEARTBEAT)
        self._port = CanPort(self._bus, [service + node for service in services for node in self._nodes])
        for node in self._nodes.values():
            self._bring_up(node)
        if not any(node.running for node in self._nodes.values()):
            raise DeviceError(f"{self._bus.place}: {self._problems()}")
        self._rounds = self._open_rounds()
        for node in self._nodes.values():
            if node.running:
                self._rounds.join(node.encoder.name)

    def read(self) -> None:
        self._tell_health()
        self._serve(time.monotonic_ns() + int(READ_S * 1e9), until=lambda: self._due() is not None)
        if (node := self._due()) is not None:
            self._bring_up(node)
            if node.running and self._rounds is not None:
                self._rounds.join(node.encoder.name)
        if not any(node.running for node in self._nodes.values()):
            raise DeviceError(f"{self._bus.place}: {self._problems()}")

    def disconnect(self) -> None:
        self._rounds = None
        for node in self._nodes.values():
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
        return SyncRounds(self.grid, sync_wire_ns, len(self._nodes) * position_wire_ns)

    # Bringing a node up

    def _due(self) -> Node | None:
        """A node that is to be brought up now; a running one that fell silent is no longer running."""
        now_ns = time.monotonic_ns()
        for node in self._nodes.values():
            if node.running and now_ns - node.heard_ns > LOST_NS:
                node.settings, node.problem, node.sought_ns = None, "heartbeat lost", now_ns
            if node.booted or (not node.running and now_ns - node.sought_ns > SEEK_NS):
                return node
        return None

    def _bring_up(self, node: Node) -> None:
        """Configure the node and start it; what is wrong with it is told in its `problem`. Raises: DeviceError."""
        port = self._opened()
        node.settings, node.booted, node.emergency = None, False, None
        objects = NodeObjects(node.address, port.send, self._await_reply)
        pre_operational = protocol.nmt_command(protocol.ENTER_PRE_OPERATIONAL, node.address)
        try:
            self.identity[node.encoder.name] = identify(objects, node.address, self._bus)
            port.send(pre_operational)
            settings = configure(objects, node.address, node.encoder, self._bus)
        except NodeSilentError as error:
            node.problem = f"no answer ({error})"
            port.send(pre_operational)  # one that was stopped answers after this
        except CanOpenError as error:
            node.problem = str(error)
        else:
            port.send(protocol.nmt_command(protocol.START, node.address))
            self._maker.set_modulus(node.encoder.name, settings.total_range)
            node.settings, node.problem, node.missed = settings, "", 0
            node.started_ns = node.heard_ns = time.monotonic_ns()
            self._tally["starts"] += 1
        node.sought_ns = time.monotonic_ns()

    def _await_reply(self, node: int, deadline_ns: int) -> bytes | None:
        self._sdo_reply = None
        self._serve(deadline_ns, until=lambda: self._sdo_reply is not None and self._sdo_reply.node == node)
        reply, self._sdo_reply = self._sdo_reply, None
        return reply.data if reply is not None else None

    # Serving the bus

    def _serve(self, end_ns: int, until: Callable[[], bool]) -> None:
        """Receive, and keep the rounds going, until the time is over or something has come about."""
        port = self._opened()
        while not until() and not self._stopping.is_set() and (now_ns := time.monotonic_ns()) < end_ns:
            wake_ns = end_ns
            if self._rounds is not None:
                wake_ns = min(end_ns, self._rounds.next_ns(now_ns))
                if wake_ns <= now_ns:
                    self._step_round(self._rounds, port, now_ns)
                    continue
            received = port.receive((wake_ns - now_ns) * 1e-9)
            if received is not None:
                self._take(*received)

    def _step_round(self, rounds: SyncRounds | TimerRounds, port: CanPort, now_ns: int) -> None:
        fixes = rounds.step(now_ns)
        if fixes is None:
            rounds.sent(port.send(protocol.SYNC_FRAME))
        else:
            self._finish_round(fixes)

    def _take(self, frame: Frame, arrived_ns: int) -> None:
        try:
            said = protocol.decode(frame)
            node = self._nodes.get(said.node) if said is not None else None
            if said is None or node is None:
                return
            match said:
                case Heartbeat():
                    self._take_heartbeat(node, said, arrived_ns)
                case Emergency():
                    node.emergency = said if said.code else None
                    self._tally["emergencies"] += said.code != 0
                case SdoReply():
                    self._sdo_reply = said
                case Pdo():
                    self._take_position(node, said, arrived_ns)
            node.heard_ns = arrived_ns
        except CanOpenError as error:
            self._tally["garbled"] += 1
            self._last_garbled = str(error)

    def _take_heartbeat(self, node: Node, heartbeat: Heartbeat, arrived_ns: int) -> None:
        if heartbeat.state == protocol.BOOT_UP:
            self._tally["restarts"] += node.running
            node.booted = True
        elif node.running and heartbeat.state != protocol.OPERATIONAL and arrived_ns - node.started_ns > SETTLING_NS:
            node.booted = True  # its boot-up message was missed, or somebody stopped it

    def _take_position(self, node: Node, pdo: Pdo, arrived_ns: int) -> None:
        settings = node.settings
        if settings is None or pdo.number != settings.pdo or self._rounds is None:
            return
        raw = protocol.decode_position(pdo.data, settings.shift, settings.total_range)
        fixes = self._rounds.add(node.encoder.name, raw, arrived_ns)
        if fixes is not None:
            self._finish_round(fixes)

    def _finish_round(self, fixes: Mapping[str, Fix]) -> None:
        for node in self._nodes.values():
            node.missed = 0 if node.encoder.name in fixes or not node.running else node.missed + 1
            self._tally["missed"] += node.missed > 0
            node.booted |= node.missed >= MISSED_ROUNDS
        if fixes:
            reading = self._maker.reading(fixes)
            self._tally["doubtful turns"] += len(reading.doubtful)
            self.hand_over(reading)

    # Telling

    def _problems(self) -> str:
        return ", ".join(
            f"{node.encoder.name} (node {node.address}): {node.problem}"
            for node in self._nodes.values()
            if node.problem
        )

    def _tell_health(self) -> None:
        port = self._opened()
        told = [self._problems()] if self._problems() else []
        for node in self._nodes.values():
            if node.emergency is not None:
                told.append(f"{node.encoder.name}: {protocol.describe_emergency(node.emergency)}")
        self.message = "; ".join(told) or "connected"
        self._tally["noise"] = port.garbled
        self._tally["duplicates"] = self._rounds.duplicates if self._rounds is not None else 0
        self.diagnostics = {
            **{node.encoder.name: self._state_of(node) for node in self._nodes.values()},
            "controller": port.controller,
            **{event: str(self._tally[event]) for event in TALLIED},
            "last garbled": self._last_garbled,
        }

    def _state_of(self, node: Node) -> str:
        if node.settings is None:
            return node.problem
        return node.settings.health if node.emergency is None else protocol.describe_emergency(node.emergency)

    def _opened(self) -> CanPort:
        assert self._port is not None  # connect() opened it
        return self._port


TALLIED = ("starts", "restarts", "missed", "emergencies", "doubtful turns", "garbled", "noise", "duplicates")
