"""Bringing an encoder into the state that RTLog needs: read over SDO, written only where it differs.

In: the objects of a node, the encoder and its bus from the profile. Out: who it is, and how to read its PDO. The law:
nothing is changed in a node that is not known to be the encoder; what was written is read back; and a node that will
not have it so is refused, with the object and the reason.

    1000h, 1018h     is it an encoder, of the vendor that the profile says?
    6000h … 6002h    counts per turn as in the profile, direction not reversed, the range in whole turns
    1017h            heartbeat
    1800h or 1801h   TPDO1 by the node's timer, or TPDO2 at SYNC; 1A00h or 1A01h with the position in it

Nothing is stored in the node (1010h), and its preset is let alone: the zero is the profile's business.
"""

import logging
from dataclasses import dataclass

from hw_profiles.profile import CanBus, Encoder
from rtlog_server.devices.cia406 import protocol
from rtlog_server.devices.cia406.protocol import CanOpenError
from rtlog_server.devices.cia406.sdo import Address, NodeObjects, ObjectRefusedError, name

log = logging.getLogger(__name__)

HEARTBEAT_MS = 200
PDO_AT_SYNC, PDO_BY_TIMER = 2, 1  # as CiA 406 has them by default
ALL_BITS = 0xFFFF_FFFF
IDENTIFIER = 0x1FFF_FFFF  # bits of a COB-ID
MOST_MAPPED = 64  # objects in a PDO


class WrongNodeError(CanOpenError):
    """The node is no encoder, not the one that the profile says, or will not be configured as needed."""


@dataclass(frozen=True, slots=True)
class NodeSettings:
    pdo: int  # the number of the TPDO with the position
    shift: int  # bits before the position in it
    total_range: int  # positions start again here: whole turns
    health: str  # what it says of itself: "ok", or its alarms and warnings


def identify(objects: NodeObjects, node: int, bus: CanBus) -> str:
    """Who the node is, for a person; nothing is changed. Raises: WrongNodeError, CanOpenError, DeviceError."""
    device_type = objects.read(protocol.DEVICE_TYPE)
    if device_type & 0xFFFF != protocol.PROFILE:
        raise WrongNodeError(f"is {protocol.describe_device_type(device_type)}, no encoder ({protocol.PROFILE})")
    vendor = objects.read(protocol.VENDOR)
    if bus.vendor_id is not None and vendor != bus.vendor_id:
        raise WrongNodeError(f"is of vendor {vendor:#x}; encoder_bus.vendor_id is {bus.vendor_id:#x}")
    try:
        model = objects.read_text(protocol.DEVICE_NAME)
    except ObjectRefusedError:
        model = "CiA 406 encoder"
    numbers = (protocol.PRODUCT, protocol.REVISION, protocol.SERIAL_NUMBER)
    product, revision, serial = (_optional(objects, address) for address in numbers)
    made = f"vendor {vendor:#x}, product {product:#x}, revision {revision:#x}"
    return f"{model}, node {node}, {made}, serial number {serial}"


def configure(objects: NodeObjects, node: int, encoder: Encoder, bus: CanBus) -> NodeSettings:
    """Write what differs. Raises: WrongNodeError, CanOpenError, DeviceError."""
    total_range = _set_scale(objects, encoder)
    _settle(objects, protocol.HEARTBEAT_MS, HEARTBEAT_MS, 2)
    pdo = PDO_AT_SYNC if bus.trigger == "sync" else PDO_BY_TIMER
    shift = _map_position(objects, node, pdo)
    _set_trigger(objects, pdo, bus)
    return NodeSettings(pdo, shift, total_range, _health(objects))


def _set_scale(objects: NodeObjects, encoder: Encoder) -> int:
    """Counts per turn and direction; returns the total range."""
    wanted = encoder.counts_per_turn
    steps, turns = _optional(objects, protocol.STEPS_PER_TURN), max(1, _optional(objects, protocol.TURNS))
    operating = objects.read(protocol.OPERATING)
    scaled = bool(operating & protocol.SCALED)
    if not scaled and steps == wanted:
        _settle(objects, protocol.OPERATING, operating & ~protocol.REVERSED, 2)
        return steps * turns
    _settle(objects, protocol.UNITS_PER_TURN, wanted, 4)
    total_range = objects.read(protocol.TOTAL_RANGE)
    if total_range == 0 or total_range % wanted:
        total_range = wanted * min(turns, ALL_BITS // wanted)
        _settle(objects, protocol.TOTAL_RANGE, total_range, 4)
    _settle(objects, protocol.OPERATING, operating & ~protocol.REVERSED | protocol.SCALED, 2)
    return total_range


def _map_position(objects: NodeObjects, node: int, pdo: int) -> int:
    """Have the position in the PDO, and the PDO sent under its usual identifier; returns the bits before the position.

    A PDO must be off while its mapping or its identifier is changed.
    """
    communication, mapping = protocol.PDO_COMMUNICATION[pdo], protocol.PDO_MAPPING[pdo]
    cob_id = objects.read((communication, protocol.COB_ID))
    count = min(objects.read((mapping, 0)), MOST_MAPPED)
    shift = protocol.position_shift([objects.read((mapping, 1 + k)) for k in range(count)])
    wanted = cob_id & ~(protocol.PDO_DISABLED | IDENTIFIER) | protocol.TPDO[pdo] + node
    if shift is None or (cob_id ^ wanted) & IDENTIFIER:
        _settle(objects, (communication, protocol.COB_ID), cob_id | protocol.PDO_DISABLED, 4)
    if shift is None:
        _settle(objects, (mapping, 0), 0, 1)
        _settle(objects, (mapping, 1), protocol.POSITION_ENTRY, 4)
        _settle(objects, (mapping, 0), 1, 1)
    _settle(objects, (communication, protocol.COB_ID), wanted, 4)
    return shift or 0


def _set_trigger(objects: NodeObjects, pdo: int, bus: CanBus) -> None:
    communication = protocol.PDO_COMMUNICATION[pdo]
    transmission = (communication, protocol.TRANSMISSION_TYPE)
    if bus.trigger == "sync":
        _settle(objects, transmission, protocol.EACH_SYNC, 1)
        return
    if objects.read(transmission) not in protocol.TIMER_TYPES:
        _settle(objects, transmission, protocol.TIMER_TYPES[0], 1)
    try:
        _settle(objects, (communication, protocol.EVENT_TIMER_MS), bus.timer_ms, 2)
    except WrongNodeError:  # older encoders have this one in its place
        _settle(objects, protocol.CYCLIC_TIMER_MS, bus.timer_ms, 2)


def _health(objects: NodeObjects) -> str:
    """ "ok", or what the node has to complain about."""
    sources = {
        "error register": protocol.ERROR_REGISTER,
        "alarms": protocol.ALARMS,
        "warnings": protocol.WARNINGS,
    }
    bits = {what: _optional(objects, address) for what, address in sources.items()}
    return ", ".join(f"{what} {number:02X}h" for what, number in bits.items() if number) or "ok"


def _settle(objects: NodeObjects, address: Address, wanted: int, size: int) -> None:
    """Have `wanted` in the object. Raises: WrongNodeError: the node will not."""
    try:
        found = objects.read(address)
        if found == wanted:
            return
        objects.write(address, wanted, size)
        log.info("object %s: %d in place of %d", name(address), wanted, found)
        found = objects.read(address)
    except ObjectRefusedError as error:
        raise WrongNodeError(f"does not take {wanted}: {error}") from error
    if found != wanted:
        raise WrongNodeError(f"object {name(address)} stays at {found} and must be {wanted}")


def _optional(objects: NodeObjects, address: Address) -> int:
    """0 where the node has no such object."""
    try:
        return objects.read(address)
    except ObjectRefusedError:
        return 0
