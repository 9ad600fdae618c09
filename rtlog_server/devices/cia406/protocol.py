"""CiA 406 encoders on CANopen: frames as bytes, both ends. No I/O, no clock; SDO transfers are `sdo.py`'s.

In: CAN identifiers (11 bits) and data. Out: what a node says (`decode`), and the frames to send. The identifier tells
service and node, n = 1 … 127; numbers go least significant byte first.

    000      cc nn                    NMT: command cc to node nn (0: all)
    080                               SYNC: every node latches its position
    080+n    code code reg v v v v v  EMCY: error code (0: no error any more), error register, vendor's bytes
    180+n    position …               TPDO1, sent on its own clock; 280+n TPDO2, sent at SYNC
    580+n    8 bytes                  SDO reply; 600+n request
    700+n    state                    heartbeat; state 0 is the boot-up message

Sources: manuals of TR-Electronic (LA-46, CEH-110, CEV-58, CM-36) and ASM (Posirot); error frames: linux/can/error.h.
"""

from collections.abc import Sequence
from dataclasses import dataclass

NMT, SYNC, EMCY, SDO_REPLY, SDO_REQUEST, HEARTBEAT = 0x000, 0x080, 0x080, 0x580, 0x600, 0x700
TPDO = {1: 0x180, 2: 0x280}  # by number
NODES = 1 << 7

START, STOP, ENTER_PRE_OPERATIONAL, RESET_NODE, RESET_COMMUNICATION = 0x01, 0x02, 0x80, 0x81, 0x82  # NMT commands
BOOT_UP, STOPPED, OPERATIONAL, PRE_OPERATIONAL = 0x00, 0x04, 0x05, 0x7F

DEVICE_TYPE, VENDOR, PRODUCT, REVISION, SERIAL_NUMBER = (0x1000, 0), (0x1018, 1), (0x1018, 2), (0x1018, 3), (0x1018, 4)
ERROR_REGISTER, DEVICE_NAME, HEARTBEAT_MS = (0x1001, 0), (0x1008, 0), (0x1017, 0)
PDO_COMMUNICATION, PDO_MAPPING = {1: 0x1800, 2: 0x1801}, {1: 0x1A00, 2: 0x1A01}  # by number
COB_ID, TRANSMISSION_TYPE, EVENT_TIMER_MS = 1, 2, 5  # sub-indices of PDO_COMMUNICATION
OPERATING, UNITS_PER_TURN, TOTAL_RANGE = (0x6000, 0), (0x6001, 0), (0x6002, 0)
POSITION, CYCLIC_TIMER_MS = (0x6004, 0), (0x6200, 0)
STEPS_PER_TURN, TURNS, ALARMS, WARNINGS = (0x6501, 0), (0x6502, 0), (0x6503, 0), (0x6505, 0)

REVERSED, SCALED = 1 << 0, 1 << 2  # of OPERATING
PDO_DISABLED = 1 << 31  # of COB_ID
EACH_SYNC = 1  # transmission types
TIMER_TYPES = (254, 255)

POSITION_BITS = 32
POSITION_ENTRY = POSITION[0] << 16 | POSITION[1] << 8 | POSITION_BITS  # of a PDO mapping

PROFILE = 406
PROFILE_NAMES = {
    401: "input and output module",
    402: "drive",
    404: "measuring device",
    405: "programmable controller",
    406: "encoder",
    408: "hydraulic valve",
    410: "inclinometer",
    418: "battery",
    419: "charger",
}

ERROR_CLASSES = {  # CiA 301, by the high byte of the code, or its high nibble in place of a byte that is not here
    0x10: "generic error",
    0x20: "current",
    0x30: "voltage",
    0x40: "temperature",
    0x50: "device hardware",
    0x60: "device software",
    0x70: "additional modules",
    0x80: "monitoring",
    0x81: "communication",
    0x82: "protocol",
    0x90: "external error",
    0xF0: "additional functions",
    0xFF: "device specific",
}


class CanOpenError(ValueError):
    """A frame that no encoder sends, or an answer that no encoder gives."""


@dataclass(frozen=True, slots=True)
class Frame:
    """A data frame with a standard identifier."""

    can_id: int
    data: bytes


@dataclass(frozen=True, slots=True)
class Heartbeat:
    node: int
    state: int  # BOOT_UP: it has just started


@dataclass(frozen=True, slots=True)
class Emergency:
    node: int
    code: int  # 0: the error is gone
    register: int
    vendor: bytes


@dataclass(frozen=True, slots=True)
class Pdo:
    node: int
    number: int
    data: bytes


@dataclass(frozen=True, slots=True)
class SdoReply:
    node: int
    data: bytes


def wire_ns(data_bytes: int, bitrate: int) -> int:
    """How long a frame takes on the wire, without stuff bits (they add a tenth at most)."""
    return (47 + 8 * data_bytes) * 1_000_000_000 // bitrate


# What nodes say


def node_of(frame: Frame) -> int:
    """The node that a frame comes from or goes to; 0: all of them."""
    return frame.can_id & (NODES - 1)


def decode(frame: Frame) -> Heartbeat | Emergency | Pdo | SdoReply | None:
    """What a node said; None: the frame is none of a node's. Raises: CanOpenError: its length is wrong."""
    service, node = frame.can_id & ~(NODES - 1), node_of(frame)
    if node == 0 or frame.can_id >= 1 << 11:
        return None
    if service == HEARTBEAT:
        _check_length("heartbeat", node, frame.data, 1)
        return Heartbeat(node, frame.data[0] & 0x7F)
    if service == EMCY:
        _check_length("emergency", node, frame.data, 8)
        return Emergency(node, int.from_bytes(frame.data[:2], "little"), frame.data[2], frame.data[3:])
    if service == SDO_REPLY:
        _check_length("SDO reply", node, frame.data, 8)
        return SdoReply(node, frame.data)
    for number, base in TPDO.items():
        if service == base:
            return Pdo(node, number, frame.data)
    return None


def _check_length(what: str, node: int, data: bytes, length: int) -> None:
    if len(data) != length:
        raise CanOpenError(f"{what} of node {node} has {len(data)} bytes, not {length}")


def describe_emergency(emergency: Emergency) -> str:
    """One line for a person."""
    high = emergency.code >> 8
    meaning = ERROR_CLASSES.get(high, ERROR_CLASSES.get(high & 0xF0, "unknown class"))
    text = f"emergency {emergency.code:04X}h, {meaning}, error register {emergency.register:02X}h"
    return text + (f", vendor's {emergency.vendor.hex(' ')}" if any(emergency.vendor) else "")


def position_shift(entries: Sequence[int]) -> int | None:
    """How many bits lie before the position in a PDO of this mapping (1A00h and the like); None: it has none."""
    shift = 0
    for entry in entries:
        if entry == POSITION_ENTRY:
            return shift
        shift += entry & 0xFF
    return None


def decode_position(data: bytes, shift: int, total_range: int) -> int:
    """Counts from 0 up to the total range. Raises: CanOpenError: too few bytes, or beyond the range."""
    if 8 * len(data) < shift + POSITION_BITS:
        raise CanOpenError(f"PDO of {len(data)} bytes is too short for its position")
    counts = int.from_bytes(data, "little") >> shift & ((1 << POSITION_BITS) - 1)
    if counts >= total_range:
        raise CanOpenError(f"position {counts} lies beyond the {total_range} counts of the encoder")
    return counts


def describe_device_type(device_type: int) -> str:
    """The device profile in words."""
    profile = device_type & 0xFFFF
    name = PROFILE_NAMES.get(profile)
    return f"device profile {profile}" + (f" ({name})" if name else "")


BUS_OFF_CLASS, NO_ACKNOWLEDGE_CLASS, CONTROLLER_CLASS, RESTARTED_CLASS = 0x40, 0x20, 0x04, 0x100
CONTROLLER_PASSIVE, CONTROLLER_ACTIVE = 0x30, 0x40  # of the data's second byte


def describe_error_frame(classes: int, data: bytes) -> str:
    """What the CAN controller reports of itself (Linux); `classes` are the frame's identifier bits."""
    state = data[1] if classes & CONTROLLER_CLASS and len(data) > 1 else 0
    if classes & BUS_OFF_CLASS:
        return "bus-off"
    if state & CONTROLLER_PASSIVE:
        return "error passive"
    if state & CONTROLLER_ACTIVE:
        return "ok"  # its error counters have fallen again
    if classes & NO_ACKNOWLEDGE_CLASS:
        return "no acknowledge"
    return "restarted" if classes & RESTARTED_CLASS else "bus errors"


# What is said to nodes


def nmt_command(command: int, node: int) -> Frame:
    return Frame(NMT, bytes([command, node]))


SYNC_FRAME = Frame(SYNC, b"")


# The node's end


def encode_heartbeat(node: int, state: int) -> Frame:
    return Frame(HEARTBEAT + node, bytes([state]))


def encode_emergency(emergency: Emergency) -> Frame:
    code = emergency.code.to_bytes(2, "little")
    return Frame(EMCY + emergency.node, code + bytes([emergency.register]) + emergency.vendor.ljust(5, b"\0"))
