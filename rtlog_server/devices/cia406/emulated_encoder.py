"""A CiA 406 encoder as its host meets it: objects, network management, positions at SYNC or by its timer. No I/O.

In: frames and the time. Out: frames. A multi-turn encoder as it comes from the maker: heartbeat off, TPDO1 by timer and
TPDO2 at SYNC, pre-operational after power-up, and all that a host configured forgotten then. canopen's SDO server does
the transfers; what an object takes and refuses is here.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, cast

import canopen
from canopen.sdo.server import SdoServer

from rtlog_server.devices.cia406 import protocol
from rtlog_server.devices.cia406.protocol import Frame
from rtlog_server.devices.cia406.sdo import Address

VENDOR_ID, PRODUCT_CODE, REVISION = 0x2F1, 0x406, 0x0001_0002
FIRST_SERIAL_NUMBER = 83_000  # of the encoder with node id 0
MODEL = "Emulated multi-turn encoder"
TURNS = 4096
MULTI_TURN = 2 << 16
NEVER_NS = 1 << 62

NO_OBJECT, NO_SUB_INDEX, READ_ONLY = 0x0602_0000, 0x0609_0011, 0x0601_0002  # SDO abort codes
WRONG_LENGTH, OUT_OF_RANGE, NOT_NOW, NOT_MAPPABLE = 0x0607_0010, 0x0609_0030, 0x0800_0022, 0x0604_0041


@dataclass(slots=True)
class Entry:
    """An object: a number of so many bytes, or a text."""

    value: int | str
    size: int = 4
    writable: bool = False


class EmulatedEncoder:
    """One node, from power-up on.

    Args:
        node: its id.
        counts_per_turn: of `position`, and of the encoder until a host scales it.
        position: (monotonic ns) → counts over many turns.
    """

    def __init__(self, node: int, counts_per_turn: int, position: Callable[[int], int]) -> None:
        self.node = node
        self._counts_per_turn = counts_per_turn
        self._position = position
        self.object_dictionary = canopen.ObjectDictionary()  # for canopen: what is here is in `objects`
        self.written: list[tuple[Address, int]] = []  # by a host over SDO
        self.power_up(0)

    # Life

    def power_up(self, now_ns: int) -> list[Frame]:
        """Everything as it came from the maker; the boot-up message."""
        self.objects = default_objects(self.node, self._counts_per_turn)
        return self._restart(now_ns)

    def _restart(self, now_ns: int) -> list[Frame]:
        self.state = protocol.PRE_OPERATIONAL
        self._syncs = 0
        self._now_ns = now_ns
        self._heartbeat_ns = self._event_ns = NEVER_NS
        self._replies: list[Frame] = []
        # canopen asks of its node and its network no more than is here under "What canopen's SDO server asks".
        self._server = cast(Any, SdoServer(protocol.SDO_REQUEST + self.node, protocol.SDO_REPLY + self.node, self))
        self._server.network = self
        return [protocol.encode_heartbeat(self.node, protocol.BOOT_UP)]

    def due_ns(self) -> int:
        """When `tick` has something to send next."""
        return min(self._heartbeat_ns, self._event_ns)

    def tick(self, now_ns: int) -> list[Frame]:
        """Heartbeat and positions by timer."""
        self._now_ns = now_ns
        frames = []
        if now_ns >= self._heartbeat_ns:
            frames.append(protocol.encode_heartbeat(self.node, self.state))
            self._heartbeat_ns = max(self._heartbeat_ns + self._heartbeat_period_ns(), now_ns)
        if now_ns >= self._event_ns:
            frames.append(self._pdo(1))
            self._event_ns = max(self._event_ns + self._event_period_ns(), now_ns)
        return frames

    def take(self, frame: Frame, now_ns: int) -> list[Frame]:
        """A frame from the bus, and what the node answers."""
        self._now_ns = now_ns
        if frame.can_id == protocol.NMT and len(frame.data) == 2 and frame.data[1] in (0, self.node):
            return self._obey(frame.data[0], now_ns)
        if frame.can_id == protocol.SYNC and self.state == protocol.OPERATIONAL:
            self._syncs += 1
            return [self._pdo(number) for number in protocol.TPDO if self._is_due_at_sync(number)]
        if frame.can_id == protocol.SDO_REQUEST + self.node and self.state != protocol.STOPPED and len(frame.data) == 8:
            self._replies = []
            self._server.on_request(frame.can_id, frame.data, 0.0)
            return self._replies
        return []

    def _obey(self, command: int, now_ns: int) -> list[Frame]:
        if command == protocol.RESET_NODE:
            return self.power_up(now_ns)
        if command == protocol.RESET_COMMUNICATION:
            return self._restart(now_ns)
        states = {
            protocol.START: protocol.OPERATIONAL,
            protocol.STOP: protocol.STOPPED,
            protocol.ENTER_PRE_OPERATIONAL: protocol.PRE_OPERATIONAL,
        }
        self.state = states.get(command, self.state)
        self._set_timers()
        return []

    # Timers and PDOs

    def number(self, address: Address) -> int:
        """An object's value."""
        value = self.objects[address].value
        assert isinstance(value, int)
        return value

    def _heartbeat_period_ns(self) -> int:
        return self.number(protocol.HEARTBEAT_MS) * 1_000_000

    def _event_period_ns(self) -> int:
        event_timer = (protocol.PDO_COMMUNICATION[1], protocol.EVENT_TIMER_MS)
        return self.number(event_timer if event_timer in self.objects else protocol.CYCLIC_TIMER_MS) * 1_000_000

    def _set_timers(self) -> None:
        """Anew after each change of what they depend on."""
        heartbeat_ns, event_ns = self._heartbeat_period_ns(), self._event_period_ns()
        transmission = self.number((protocol.PDO_COMMUNICATION[1], protocol.TRANSMISSION_TYPE))
        timed = self.state == protocol.OPERATIONAL and event_ns and self._is_enabled(1)
        self._heartbeat_ns = self._now_ns + heartbeat_ns if heartbeat_ns else NEVER_NS
        self._event_ns = self._now_ns + event_ns if timed and transmission in protocol.TIMER_TYPES else NEVER_NS

    def _is_enabled(self, number: int) -> bool:
        return not self.number((protocol.PDO_COMMUNICATION[number], protocol.COB_ID)) & protocol.PDO_DISABLED

    def _is_due_at_sync(self, number: int) -> bool:
        transmission = self.number((protocol.PDO_COMMUNICATION[number], protocol.TRANSMISSION_TYPE))
        return self._is_enabled(number) and 1 <= transmission <= 240 and self._syncs % transmission == 0

    def _pdo(self, number: int) -> Frame:
        mapping = protocol.PDO_MAPPING[number]
        entries = [self.number((mapping, 1 + k)) for k in range(self.number((mapping, 0)))]
        data = b"".join(self.get_data(entry >> 16, entry >> 8 & 0xFF)[: (entry & 0xFF) // 8] for entry in entries)
        return Frame(self.number((protocol.PDO_COMMUNICATION[number], protocol.COB_ID)) & 0x7FF, data)

    def _raw_position(self) -> int:
        """As 6000h … 6002h scale it."""
        operating = self.number(protocol.OPERATING)
        scaled = operating & protocol.SCALED
        units = self.number(protocol.UNITS_PER_TURN if scaled else protocol.STEPS_PER_TURN)
        total = self.number(protocol.TOTAL_RANGE) if scaled else units * self.number(protocol.TURNS)
        counts = self._position(self._now_ns) * units // self._counts_per_turn
        return (-counts if operating & protocol.REVERSED else counts) % total

    # What canopen's SDO server asks of a node

    def send_message(self, can_id: int, data: bytes) -> None:
        """Its reply."""
        self._replies.append(Frame(can_id, bytes(data)))

    def get_data(self, index: int, subindex: int, check_readable: bool = True) -> bytes:  # noqa: ARG002
        """An object's bytes; all can be read. Raises: SdoAbortedError."""
        entry = self._entry((index, subindex))
        if (index, subindex) == protocol.POSITION:
            return self._raw_position().to_bytes(entry.size, "little")
        if isinstance(entry.value, str):
            return entry.value.encode("ascii")
        return entry.value.to_bytes(entry.size, "little")

    def set_data(self, index: int, subindex: int, data: bytes, check_writable: bool = True) -> None:  # noqa: ARG002
        """Write an object as a host does. Raises: SdoAbortedError."""
        entry = self._entry((index, subindex))
        if not entry.writable:
            raise canopen.SdoAbortedError(READ_ONLY)
        if len(data) != entry.size:
            raise canopen.SdoAbortedError(WRONG_LENGTH)
        number = int.from_bytes(data, "little")
        self._check((index, subindex), number)
        entry.value = number
        self.written.append(((index, subindex), number))
        self._set_timers()

    def _entry(self, address: Address) -> Entry:
        if address not in self.objects:
            known = any(index == address[0] for index, _ in self.objects)
            raise canopen.SdoAbortedError(NO_SUB_INDEX if known else NO_OBJECT)
        return self.objects[address]

    def _check(self, address: Address, number: int) -> None:
        """What CiA 301 forbids: another identifier for a PDO that is on, another mapping for one that is used."""
        index, subindex = address
        if index in protocol.PDO_COMMUNICATION.values() and subindex == protocol.COB_ID:
            changed = (self.number(address) ^ number) & ~protocol.PDO_DISABLED
            if changed and not self.number(address) & protocol.PDO_DISABLED:
                raise canopen.SdoAbortedError(OUT_OF_RANGE)
        for pdo, mapping in protocol.PDO_MAPPING.items():
            if index == mapping and (self._is_enabled(pdo) or (subindex and self.number((mapping, 0)))):
                raise canopen.SdoAbortedError(NOT_NOW)
            if index == mapping and subindex and (number >> 16, number >> 8 & 0xFF) not in self.objects:
                raise canopen.SdoAbortedError(NOT_MAPPABLE)
        if address in (protocol.UNITS_PER_TURN, protocol.TOTAL_RANGE) and number == 0:
            raise canopen.SdoAbortedError(OUT_OF_RANGE)


def default_objects(node: int, counts_per_turn: int) -> dict[Address, Entry]:
    """The object dictionary as it came from the maker."""
    objects = {
        protocol.DEVICE_TYPE: Entry(MULTI_TURN | protocol.PROFILE),
        protocol.ERROR_REGISTER: Entry(0, 1),
        protocol.DEVICE_NAME: Entry(MODEL),
        protocol.HEARTBEAT_MS: Entry(0, 2, True),
        protocol.VENDOR: Entry(VENDOR_ID),
        protocol.PRODUCT: Entry(PRODUCT_CODE),
        protocol.REVISION: Entry(REVISION),
        protocol.SERIAL_NUMBER: Entry(FIRST_SERIAL_NUMBER + node),
        protocol.OPERATING: Entry(protocol.SCALED, 2, True),
        protocol.UNITS_PER_TURN: Entry(counts_per_turn, 4, True),
        protocol.TOTAL_RANGE: Entry(counts_per_turn * TURNS, 4, True),
        protocol.POSITION: Entry(0),
        protocol.STEPS_PER_TURN: Entry(counts_per_turn),
        protocol.TURNS: Entry(TURNS, 2),
        protocol.ALARMS: Entry(0, 2),
        protocol.WARNINGS: Entry(0, 2),
    }
    for pdo, transmission in ((1, protocol.TIMER_TYPES[0]), (2, protocol.EACH_SYNC)):
        communication, mapping = protocol.PDO_COMMUNICATION[pdo], protocol.PDO_MAPPING[pdo]
        objects |= {
            (communication, protocol.COB_ID): Entry(protocol.TPDO[pdo] + node, 4, True),
            (communication, protocol.TRANSMISSION_TYPE): Entry(transmission, 1, True),
            (communication, protocol.EVENT_TIMER_MS): Entry(0, 2, True),
            (mapping, 0): Entry(1, 1, True),
            (mapping, 1): Entry(protocol.POSITION_ENTRY, 4, True),
            (mapping, 2): Entry(0, 4, True),
        }
    return objects
