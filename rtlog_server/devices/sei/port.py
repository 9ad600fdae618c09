"""The serial port with the SEI adapter: one request out, one reply in, echo stripped, baud rate settled.

In: requests of `protocol`. Out: replies and when they came (monotonic clock). Every way in which a USB adapter can
vanish comes out as one DeviceError.
"""

import contextlib
import errno
import os
import termios
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import serial

from hw_profiles.profile import Encoder, SeiBus
from rtlog_server.devices.device import DeviceError
from rtlog_server.devices.sei import protocol

TIMEOUT_S = 0.03  # for one reply; field drivers use 10 … 30 ms
BAUD_CHANGE_S = 0.02  # its reply, of unpublished length, is waited out
ECHO_ATTEMPTS = 4  # for each encoder


@dataclass(frozen=True, slots=True)
class Exchange:
    reply: bytes  # empty: no encoder answered
    sent_ns: int  # when the request was given to the port
    complete_ns: int  # when the reply was in


class SeiPort:
    """An open bus. Raises, here and in all its methods: DeviceError, the port is lost or taken."""

    def __init__(self, bus: SeiBus) -> None:
        self._bus = bus
        self._echo = bus.echo == "yes"
        try:
            # exclusive: two readers of one port steal each other's bytes
            self._serial = serial.Serial(
                bus.port, protocol.POWER_UP_BAUD, timeout=TIMEOUT_S, write_timeout=1.0, exclusive=True
            )
        except OSError as error:
            taken = error.errno in (errno.EAGAIN, errno.EBUSY)
            reason = "another process has it" if taken else os.strerror(error.errno or errno.EIO)
            raise DeviceError(f"{bus.port}: cannot open the port: {reason}") from error
        except termios.error as error:
            raise DeviceError(f"{bus.port}: is no serial port: {error.args[-1]}") from error
        # USB adapters collect bytes for 16 ms unless told otherwise; other ports have no such switch.
        with contextlib.suppress(ValueError):
            self._serial.set_low_latency_mode(True)

    @property
    def echo(self) -> bool:
        """Whether the adapter returns what is sent."""
        return self._echo

    def close(self) -> None:
        with contextlib.suppress(OSError):
            self._serial.close()

    def exchange(self, request: bytes, reply_bytes: int) -> Exchange:
        """Ask and wait for the whole reply or the time-out. Raises: SeiError, the echo is another than was sent."""
        sent_ns, received = self._send_and_read(request, reply_bytes + len(request) * self._echo)
        complete_ns = time.monotonic_ns()
        return Exchange(protocol.strip_echo(received, request, self._echo), sent_ns, complete_ns)

    def settle(self, encoders: Sequence[Encoder]) -> None:
        """Bring the encoders to the profile's baud rate and find out whether the adapter echoes.

        Raises:
            DeviceError: no encoder answers, or otherwise than the profile says.
        """
        if self._bus.baud != protocol.POWER_UP_BAUD:
            self.raise_baud()
        try:
            # A profile with a bus was checked to hold every address.
            reply_bytes = protocol.position_reply_bytes(self._bus.turns == "multi")
            self.learn_echo([encoder.address or 0 for encoder in encoders], reply_bytes)
        except DeviceError:
            if self._bus.baud == protocol.POWER_UP_BAUD:
                self.reset_fast_encoders()
            raise
        if self._bus.echo != "auto" and self._echo != (self._bus.echo == "yes"):
            raise DeviceError(f"{self._bus.port}: encoder_bus.echo is {self._bus.echo!r}, but the adapter differs")

    def learn_echo(self, addresses: Sequence[int], reply_bytes: int) -> None:
        """Find out by position requests whether the adapter echoes; two in succession must agree.

        Raises:
            DeviceError: no encoder answers, or with another number of bytes than the profile lets expect.
        """
        received = b""
        for address in addresses:
            verdicts: list[bool | None] = []
            for _ in range(ECHO_ATTEMPTS):
                request = protocol.position_request(address)
                # One byte more than the longest answer: what is too long must not pass for right.
                _, answer = self._send_and_read(request, len(request) + reply_bytes + 1)
                received = answer if len(answer) > len(request) else received
                verdicts.append(protocol.learn_echo(answer, request, reply_bytes))
                if len(verdicts) > 1 and verdicts[-1] is not None and verdicts[-1] == verdicts[-2]:
                    self._echo = verdicts[-1]
                    return
        if received:
            raise DeviceError(
                f"{self._bus.port}: {len(received)} bytes ({received.hex(' ')}) answer a position request; with"
                f" encoder_bus.turns = {self._bus.turns!r} it must be {reply_bytes}, or {reply_bytes + 1} with echo"
            )
        raise DeviceError(f"{self._bus.port}: no encoder answers")

    def raise_baud(self) -> None:
        """Bring every encoder from 9600 to 115200 baud; those that are there already see noise and ignore it."""
        with self._guard():
            self._serial.baudrate = protocol.POWER_UP_BAUD
        self._send_and_drain(protocol.fast_baud_request())
        with self._guard():
            self._serial.baudrate = self._bus.baud

    def reset_fast_encoders(self) -> None:
        """Bring encoders that another program left at 115200 baud back to 9600."""
        with self._guard():
            self._serial.baudrate = protocol.BAUD_CODES[0]
        self._send_and_drain(protocol.reset_request())
        with self._guard():
            self._serial.baudrate = self._bus.baud

    def _send_and_read(self, request: bytes, length: int) -> tuple[int, bytes]:
        with self._guard():
            self._serial.reset_input_buffer()  # a late reply must not pass for the next
            # Before the write: after it, other threads of the process may hold this one up for long.
            sent_ns = time.monotonic_ns()
            self._serial.write(request)
            return sent_ns, self._serial.read(length)

    def _send_and_drain(self, request: bytes) -> None:
        with self._guard():
            self._serial.write(request)
            self._serial.flush()
            time.sleep(BAUD_CHANGE_S)
            self._serial.reset_input_buffer()

    @contextlib.contextmanager
    def _guard(self) -> Iterator[None]:
        try:
            yield
        except (OSError, termios.error) as error:
            raise DeviceError(f"{self._bus.port}: lost the port: {error}") from error
