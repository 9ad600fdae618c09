"""The encoders on the bus as they tell of themselves: who runs, who is away, what is wrong with it. No I/O, no clock.

In: frames and the rounds' ends. Out: positions of a whole round, the nodes that are to be brought up, lines for people.

    away ──brought up──> running ── silent for 2.5 heartbeats ──> away
                            └── booted, stopped, without positions for 8 rounds ──> to be brought up again

The law: whatever frame comes costs bounded memory and raises nothing; what no encoder sends is counted.
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from hw_profiles.profile import Encoder
from rtlog_server.devices.cia406 import protocol
from rtlog_server.devices.cia406.configuration import HEARTBEAT_MS, NodeSettings
from rtlog_server.devices.cia406.protocol import CanOpenError, Emergency, Frame, Heartbeat, Pdo, SdoReply
from rtlog_server.devices.cia406.rounds import SyncRounds, TimerRounds
from rtlog_server.devices.encoders import Fix

LOST_NS = 5 * HEARTBEAT_MS * 1_000_000 // 2  # without any frame from a node
SETTLING_NS = 2 * HEARTBEAT_MS * 1_000_000  # after the start command, in which old heartbeats still come
MISSED_ROUNDS = 8  # of a node that is alive: its PDO was configured away
SEEK_NS = 500_000_000  # a node that is away is asked for this often; one that boots says so itself


@dataclass(slots=True)
class Node:
    """One encoder."""

    encoder: Encoder
    address: int
    settings: NodeSettings | None = None  # None: it is away
    problem: str = "not asked yet"  # "" while it runs
    booted: bool = False  # or stopped, or lost its configuration: to be brought up again
    heard_ns: int = 0
    started_ns: int = 0
    sought_ns: int = 0
    missed: int = 0  # rounds in succession
    emergency: Emergency | None = None  # the newest that is not over

    @property
    def name(self) -> str:
        return self.encoder.name

    @property
    def running(self) -> bool:
        return self.settings is not None

    @property
    def health(self) -> str:
        """One line for a person."""
        if self.emergency is not None:
            return protocol.describe_emergency(self.emergency)
        return self.problem if self.settings is None else self.settings.health

    def begin(self) -> None:
        """It is about to be brought up."""
        self.settings, self.booted, self.emergency = None, False, None

    def run(self, settings: NodeSettings, now_ns: int) -> None:
        """It was brought up."""
        self.settings, self.problem, self.missed = settings, "", 0
        self.started_ns = self.heard_ns = now_ns


class Nodes:
    """All encoders of the bus; a profile with a bus was checked to hold every address."""

    def __init__(self, encoders: Sequence[Encoder]) -> None:
        self._nodes = {encoder.address or 0: Node(encoder, encoder.address or 0) for encoder in encoders}
        self.rounds: SyncRounds | TimerRounds | None = None  # None: positions are not wanted yet
        self.sdo_reply: SdoReply | None = None  # the newest
        self.tally: Counter[str] = Counter()
        self.last_garbled = "none"

    def __iter__(self) -> Iterator[Node]:
        return iter(self._nodes.values())

    @property
    def addresses(self) -> list[int]:
        return list(self._nodes)

    @property
    def any_running(self) -> bool:
        return any(node.running for node in self)

    def problems(self) -> str:
        """One line for a person; empty if there are none."""
        return ", ".join(f"{node.name} (node {node.address}): {node.problem}" for node in self if node.problem)

    def take(self, frame: Frame, arrived_ns: int) -> Mapping[str, Fix] | None:
        """A frame from the bus; the positions of a round, if it was the last one missing."""
        node = self._nodes.get(protocol.node_of(frame))
        if node is None:
            return None
        try:
            said = protocol.decode(frame)
            if said is None:
                return None
            node.heard_ns = arrived_ns
            if isinstance(said, Pdo):
                return self._take_position(node, said, arrived_ns)
        except CanOpenError as error:
            self.tally["garbled"] += 1
            self.last_garbled = str(error)
            return None
        match said:
            case Heartbeat():
                self._take_heartbeat(node, said, arrived_ns)
            case Emergency():
                node.emergency = said if said.code else None
                self.tally["emergencies"] += said.code != 0
            case SdoReply():
                self.sdo_reply = said
        return None

    def _take_heartbeat(self, node: Node, heartbeat: Heartbeat, arrived_ns: int) -> None:
        if heartbeat.state == protocol.BOOT_UP:
            self.tally["restarts"] += node.running
            node.booted = True
        elif node.running and heartbeat.state != protocol.OPERATIONAL and arrived_ns - node.started_ns > SETTLING_NS:
            node.booted = True  # its boot-up message was missed, or somebody stopped it

    def _take_position(self, node: Node, pdo: Pdo, arrived_ns: int) -> Mapping[str, Fix] | None:
        settings = node.settings
        if settings is None or pdo.number != settings.pdo or self.rounds is None:
            return None
        raw = protocol.decode_position(pdo.data, settings.shift, settings.total_range)
        return self.rounds.add(node.name, raw, arrived_ns)

    def finish_round(self, fixes: Mapping[str, Fix]) -> None:
        """Whose position a round has, and who missed it."""
        for node in self:
            node.missed = 0 if node.name in fixes or not node.running else node.missed + 1
            self.tally["missed"] += node.missed > 0
            node.booted |= node.missed >= MISSED_ROUNDS

    def due(self, now_ns: int) -> Node | None:
        """A node that is to be brought up now; a running one that fell silent is away from here on."""
        for node in self:
            if node.running and now_ns - node.heard_ns > LOST_NS:
                node.settings, node.problem, node.sought_ns = None, "heartbeat lost", now_ns
            if node.booted or (not node.running and now_ns - node.sought_ns > SEEK_NS):
                return node
        return None
