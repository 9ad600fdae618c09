"""Who is on an SEI bus and how each encoder stands: an `EncoderIdentity` for every address of the profile.

In: an open `SeiPort` that knows its echo, or a bus that nobody has open. Out: what encoders tell by public opcodes.

The resolution cannot be read (its opcode is not public): it is the profile's, and `status` says when a position lies
beyond it. The mode is told by the length of a position reply.
"""

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from hw_profiles.profile import Encoder, SeiBus
from rtlog_server.devices.sei import protocol
from rtlog_server.devices.sei.port import SeiPort
from rtlog_server.devices.sei.protocol import SeiError

ATTEMPTS = 3
MODES: dict[int, Literal["single", "multi"]] = {
    protocol.position_reply_bytes(multi_turn=False): "single",
    protocol.position_reply_bytes(multi_turn=True): "multi",
}


@dataclass(frozen=True, slots=True)
class EncoderIdentity:
    name: str  # as in the profile
    address: int
    serial_number: int | None  # None: not told
    counts_per_turn: int  # the profile's
    mode: Literal["single", "multi", ""]  # turns; "" while it does not answer
    position: int | None  # counts within the turn
    status: str  # "ok", "silent", or what is wrong with its answers

    def __str__(self) -> str:
        if self.status == "silent":
            return f"address {self.address:X}, silent"
        told = "not told" if self.serial_number is None else str(self.serial_number)
        return f"US Digital A2, address {self.address:X}, serial number {told}, {self.mode}-turn, {self.status}"


def identify_bus(bus: SeiBus, encoders: Sequence[Encoder]) -> list[EncoderIdentity]:
    """Open the bus, ask every encoder who it is, close it.

    Raises: DeviceError: the port cannot be opened or is lost, or no encoder answers.
    """
    with contextlib.closing(SeiPort(bus)) as port:
        port.settle(encoders)
        return [identify_encoder(port, encoder) for encoder in encoders]


def identify_encoder(port: SeiPort, encoder: Encoder) -> EncoderIdentity:
    """Ask one encoder who it is; one that is silent is no error. Raises: DeviceError: the port is lost."""
    address = encoder.address or 0  # a profile with a bus was checked to hold every address
    mode: Literal["single", "multi", ""] = ""
    position, status = None, "silent"
    for _ in range(ATTEMPTS):
        with contextlib.suppress(SeiError):
            # One byte more than the longest reply: the length tells the mode.
            reply = port.exchange(protocol.position_request(address), max(MODES) + 1).reply
            if not reply:
                continue
            mode = MODES.get(len(reply), "")
            position, status = _judge(reply, encoder.counts_per_turn, mode)
        if status == "ok":
            break
    return EncoderIdentity(
        encoder.name, address, _serial_number(port, address), encoder.counts_per_turn, mode, position, status
    )


def _judge(reply: bytes, counts_per_turn: int, mode: str) -> tuple[int | None, str]:
    try:
        return protocol.decode_position(reply, counts_per_turn, mode == "multi") % counts_per_turn, "ok"
    except SeiError as error:
        return None, str(error)


def _serial_number(port: SeiPort, address: int) -> int | None:
    for _ in range(ATTEMPTS):
        with contextlib.suppress(SeiError):
            reply = port.exchange(protocol.serial_number_request(address), protocol.SERIAL_REPLY_BYTES).reply
            return protocol.decode_serial_number(reply)
    return None
