"""US Digital A2 absolute encoders on the SEI bus: requests and replies as bytes, both ends. No I/O, no clock.

In: received bytes. Out: positions, serial numbers; and the requests to send. The law of the bus: one host asks, one
encoder answers at once; an encoder that does not understand is silent. Numbers go most significant byte first.

    host     1n                                    position request to address n (0 … E, F = all)
    encoder        hi lo                           single-turn mode: 0 … counts per turn - 1
    encoder        hi lo hi lo                     multi-turn mode: turns modulo 65536, then the same
    host     4F                                    strobe: in strobe mode all encoders latch now, for the next request
    adapter  1n                                    some return every byte that is sent: the *echo*

Source: US Digital, "SEI Absolute Encoder Communications Protocol". The opcode that puts an encoder into strobe mode is
not public, nor is the one that reads its mode: it is done once with US Digital's own software, and the profile says so.
"""

from dataclasses import dataclass

BROADCAST = 0xF
POWER_UP_BAUD = 9600
BITS_PER_BYTE = 10  # 8N1
SNAPSHOT_NS = 4_000_000  # the encoder looks at its disc each 4 ms and answers with the latest look
TURNS = 1 << 16  # the turn count of multi-turn mode starts again here

POSITION, STROBE = 0x1, 0x4  # a command of one byte: command nibble, address nibble
EXTENDED = 0xF  # a command of several: this nibble, address nibble, then one of
READ_SERIAL_NUMBER, RESET, SET_BAUD = 0x03, 0x0E, 0x0F
BAUD_CODES = {0x00: 115200}
DATA_BYTES = {READ_SERIAL_NUMBER: 0, 0x06: 4, 0x07: 5, 0x0A: 2, 0x0D: 1, RESET: 0, SET_BAUD: 1}

SERIAL_REPLY_BYTES = 5  # serial number, checksum


class SeiError(ValueError):
    """Received bytes that no encoder sends in answer to the request: noise, a collision or wrong settings."""


def wire_ns(length: int, baud: int) -> int:
    """How long `length` bytes take on the wire."""
    return length * BITS_PER_BYTE * 1_000_000_000 // baud


# The host's end


def position_request(address: int) -> bytes:
    return bytes([POSITION << 4 | address])


def strobe_request(address: int = BROADCAST) -> bytes:
    """Encoders in strobe mode take a reading now; nobody replies."""
    return bytes([STROBE << 4 | address])


def serial_number_request(address: int) -> bytes:
    return bytes([EXTENDED << 4 | address, READ_SERIAL_NUMBER])


def reset_request(address: int = BROADCAST) -> bytes:
    """Back to the state after power-up: 9600 baud, modes from EEPROM."""
    return bytes([EXTENDED << 4 | address, RESET])


def fast_baud_request(address: int = BROADCAST) -> bytes:
    """Go to 115200 baud, until power-down."""
    return bytes([EXTENDED << 4 | address, SET_BAUD, 0x00])


def position_reply_bytes(multi_turn: bool) -> int:
    return 4 if multi_turn else 2


def learn_echo(received: bytes, request: bytes, reply_bytes: int) -> bool | None:
    """Whether the adapter echoes, told by all that came in answer to one request; None if that does not tell.

    The length decides, for a position may begin with the very byte that asked for it (10 hex at address 0).
    """
    if len(received) == reply_bytes:
        return False
    return True if len(received) == len(request) + reply_bytes and received.startswith(request) else None


def strip_echo(received: bytes, request: bytes, echo: bool) -> bytes:
    """The reply without the echo; empty if no encoder answered. Raises: SeiError."""
    if not echo or not received:
        return received
    if not received.startswith(request):
        raise SeiError(f"echo of {request.hex()} came back as {received[: len(request)].hex()}")
    return received[len(request) :]


def decode_position(reply: bytes, counts_per_turn: int, multi_turn: bool) -> int:
    """Counts: within the turn, or modulo 65536 turns in multi-turn mode.

    Raises:
        SeiError: the reply is not whole, or its counts lie beyond the turn, where only corruption can put them.
    """
    if len(reply) != position_reply_bytes(multi_turn):
        raise SeiError(f"position reply has {len(reply)} bytes, not {position_reply_bytes(multi_turn)}")
    turns, counts = divmod(int.from_bytes(reply, "big"), TURNS)
    if counts >= counts_per_turn:
        raise SeiError(f"position {counts} lies beyond the {counts_per_turn} counts of a turn")
    return turns * counts_per_turn + counts


def decode_serial_number(reply: bytes) -> int:
    """The serial number; its checksum, of an unpublished sum, is not looked at. Raises: SeiError."""
    if len(reply) != SERIAL_REPLY_BYTES:
        raise SeiError(f"serial number reply has {len(reply)} bytes, not {SERIAL_REPLY_BYTES}")
    return int.from_bytes(reply[:4], "big")


# The encoder's end


@dataclass(frozen=True, slots=True)
class Request:
    address: int
    command: int  # POSITION, or with `extended` one of the sub-commands
    extended: bool
    data: bytes


def take_request(received: bytearray) -> Request | None:
    """Take the first request off the bytes; None: more bytes are needed. Unknown sub-commands have no data."""
    if not received:
        return None
    command, address = divmod(received[0], 16)
    if command != EXTENDED:
        del received[0]
        return Request(address, command, False, b"")
    if len(received) < 2 or len(received) < 2 + DATA_BYTES.get(received[1], 0):
        return None
    sub_command = received[1]
    end = 2 + DATA_BYTES.get(sub_command, 0)
    data = bytes(received[2:end])
    del received[:end]
    return Request(address, sub_command, True, data)


def encode_position(counts: int, counts_per_turn: int, multi_turn: bool) -> bytes:
    """The reply to a position request; `counts` over many turns."""
    turns, within = divmod(counts, counts_per_turn)
    reply = within.to_bytes(2, "big")
    return (turns % TURNS).to_bytes(2, "big") + reply if multi_turn else reply


def encode_serial_number(serial_number: int) -> bytes:
    """The reply to a serial number request. The real checksum is not public; an 8-bit sum stands in its place."""
    number = serial_number.to_bytes(4, "big")
    return number + bytes([sum(number) % 256])
