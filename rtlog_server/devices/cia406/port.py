"""The CAN interface: frames out, frames in, whatever python-can has behind it.

In: `Frame`s to send. Out: received `Frame`s and when they came (monotonic clock). Every way in which an interface can
fail comes out as one DeviceError; what is no frame at all is counted in `garbled` and dropped.
"""

import contextlib
import errno
import logging
import os
import select
import time
from collections.abc import Sequence
from typing import Any

import can

from hw_profiles.profile import CanBus
from rtlog_server.devices.cia406 import protocol
from rtlog_server.devices.cia406.protocol import Frame
from rtlog_server.devices.device import DeviceError

SEND_TIMEOUT_S = 0.05
SLCAN_SETTLE_S = 0.05  # after the serial port is opened; python-can would sleep 2 s, for boards that reset at it
SLCAN_LONGEST_LINE = 4096  # an adapter's line has 27 characters; python-can's buffer has no bound

logging.getLogger("can").setLevel(logging.CRITICAL)  # it logs each failure that it raises as well


class CanPort:
    """An open interface. Raises, here and in all its methods: DeviceError, the interface is lost or cannot be had.

    Args:
        bus: from the profile.
        can_ids: the identifiers to receive, or None for all; where the kernel filters, others cost nothing.
    """

    def __init__(self, bus: CanBus, can_ids: Sequence[int] | None = None) -> None:
        self._place = bus.place
        self.garbled = 0
        self.controller = "ok"  # what the CAN controller reported last
        try:
            self._bus = can.Bus(**_arguments(bus, can_ids))
        except (can.CanError, OSError, ValueError) as error:
            raise DeviceError(f"{self._place}: cannot open the CAN interface: {_reason(error)}") from error
        self._fileno = _fileno(self._bus)

    def close(self) -> None:
        with contextlib.suppress(can.CanError, OSError):
            self._bus.shutdown()
        # After a failure half-way (an adapter that is gone refuses the closing command) the descriptor is still open.
        serial_port = getattr(self._bus, "serialPortOrig", None)
        if serial_port is not None:
            with contextlib.suppress(OSError):
                serial_port.close()

    def fileno(self) -> int:
        """To wait on with others, as a selector does. Raises: ValueError: the interface has none."""
        if self._fileno is None:
            raise ValueError(f"{self._place}: nothing to wait on")
        return self._fileno

    def send(self, frame: Frame) -> int:
        """Send; returns when it went (the moment before: afterwards other threads may hold this one up)."""
        message = can.Message(arbitration_id=frame.can_id, data=frame.data, is_extended_id=False)
        sent_ns = time.monotonic_ns()
        try:
            self._bus.send(message, SEND_TIMEOUT_S)
        except (can.CanError, OSError) as error:
            full = _errno(error) == errno.ENOBUFS or str(error) == "Transmit buffer full"
            hint = ": nobody acknowledges; cable, terminators, bit rate" if full else ""
            raise DeviceError(f"{self._place}: cannot send: {_reason(error)}{hint}") from error
        return sent_ns

    def receive(self, timeout_s: float) -> tuple[Frame, int] | None:
        """The next frame and its arrival; None: none came within the time, or what came is none for us."""
        try:
            # python-can measures its time-outs on the wall clock, which may be set back: we wait ourselves.
            if self._fileno is None:
                message = self._bus.recv(max(0.0, timeout_s))
            elif select.select([self._fileno], [], [], max(0.0, timeout_s))[0]:
                message = self._bus.recv(0)
            else:
                return None
        except (can.CanError, OSError, ValueError, IndexError) as error:
            self._judge(error)
            return None
        arrived_ns = time.monotonic_ns()
        if message is None:
            self._bound_slcan_buffer()
            return None
        if message.is_error_frame:
            self._report(message)
            return None
        if message.is_remote_frame or message.is_extended_id or not 0 <= message.arbitration_id < 1 << 11:
            return None
        if message.is_fd or len(message.data) > 8:
            return None
        return Frame(message.arbitration_id, bytes(message.data)), arrived_ns

    def _judge(self, error: Exception) -> None:
        """Noise is counted, a lost interface raised: behind that is an error of the system."""
        if isinstance(error, OSError) or isinstance(error.__cause__, OSError):
            raise DeviceError(f"{self._place}: lost the CAN interface: {_reason(error)}") from error
        self.garbled += 1
        self._resynchronise()

    def _report(self, message: can.Message) -> None:
        self.controller = protocol.describe_error_frame(message.arbitration_id, bytes(message.data))
        if message.arbitration_id & protocol.BUS_OFF_CLASS:
            raise DeviceError(f"{self._place}: bus-off: cable, terminators, bit rate; restart-ms of the interface")

    def _bound_slcan_buffer(self) -> None:
        if len(getattr(self._bus, "_buffer", b"")) > SLCAN_LONGEST_LINE:
            self.garbled += 1
            self._resynchronise()

    def _resynchronise(self) -> None:
        """python-can keeps an undecodable line of an slcan adapter for ever, unless its buffer is flushed."""
        flush = getattr(self._bus, "flush", None)
        if flush is not None:
            try:
                flush()
            except can.CanError as error:
                raise DeviceError(f"{self._place}: lost the CAN interface: {_reason(error)}") from error


def _arguments(bus: CanBus, can_ids: Sequence[int] | None) -> dict[str, Any]:
    arguments: dict[str, Any] = {"interface": bus.interface, "channel": bus.channel, "ignore_config": True}
    if bus.interface == "socketcan" and can_ids is not None:
        arguments["can_filters"] = [{"can_id": can_id, "can_mask": 0x7FF, "extended": False} for can_id in can_ids]
    if bus.interface == "slcan":
        arguments |= {"bitrate": bus.bitrate, "sleep_after_open": SLCAN_SETTLE_S}
    if bus.interface == "udp_multicast":
        arguments |= {"port": bus.udp_port, "hop_limit": 0, "fd": False}  # nothing leaves this machine
    return arguments


def _fileno(bus: can.BusABC) -> int | None:
    """To wait on; None where the interface has none (virtual)."""
    try:
        number = bus.fileno()
    except NotImplementedError:
        return None
    return number if number >= 0 else None


def _errno(error: BaseException) -> int | None:
    """The system's number of an error, where there is one: python-can's own, or of what it was raised from."""
    number = getattr(error, "error_code", None) or getattr(error, "errno", None)
    return number if number is not None or error.__cause__ is None else _errno(error.__cause__)


def _reason(error: BaseException) -> str:
    number = _errno(error)
    return os.strerror(number) if number else str(error)
