"""The serial port with the SEI adapter: one request out, one reply in, echo stripped, baud rate settled.

In: requests of `protocol`. Out: replies and when they came (monotonic clock). Every way in which a USB adapter can
vanish comes out as one DeviceError.
"""

import contextlib
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from hw_profiles.profile import Encoder, SeiBus
from rtlog_server.devices.device import DeviceError
from rtlog_server.devices.sei import protocol
from rtlog_server.devices.sei.protocol import SeiError
from rtlog_server.devices.serial_port import LOST, open_serial_port

TIMEOUT_S = 0.03  # for one reply; field drivers use 10 … 30 ms
BAUD_CHANGE_S = 0.02  # its reply, of unpublished length, is waited out
LATE_S = 0.002  # what an adapter may hold back
DRAIN_S, DRAIN_BYTES = 0.1, 256
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
        self._serial = open_serial_port(bus.port, protocol.POWER_UP_BAUD, TIMEOUT_S)

    @property
    def echo(self) -> bool:
        """Whether the adapter returns what is sent."""
        return self._echo

    def close(self) -> None:
        with contextlib.suppress(*LOST):
            self._serial.close()

    def exchange(self, request: bytes, reply_bytes: int) -> Exchange:
        """Ask and wait for the whole reply or the time-out.

        Raises: SeiError: the echo is another than was sent, or more came than an encoder sends.
        """
        sent_ns, received = self._send_and_read(request, reply_bytes + len(request) * self._echo)
        complete_ns = time.monotonic_ns()
        with self._guard():
            excess = self._serial.in_waiting
        if excess:
            raise SeiError(f"{excess} bytes more than the reply")
        return Exchange(protocol.strip_echo(received, request, self._echo), sent_ns, complete_ns)

    def let_pass(self, reply_bytes: int) -> None:
        """Wait for an answer that may still be under way, that it is not taken for that to the next question."""
        time.sleep(LATE_S + protocol.wire_ns(reply_bytes, self._bus.baud) * 1e-9)

    def strobe(self) -> int:
        """Let all encoders that are in strobe mode latch at once; when the request was given to the port."""
        return self._send_and_read(protocol.strobe_request(), int(self._echo))[0]

    def settle(self, encoders: Sequence[Encoder]) -> None:
        """Bring the encoders to the profile's baud rate and find out whether the adapter echoes.

        Raises:
            DeviceError: no encoder answers, or otherwise than the profile says.
        """
        if self._bus.baud != protocol.POWER_UP_BAUD:
            self.recover_baud()
        try:
            # A profile with a bus was checked to hold every address.
            reply_bytes = protocol.position_reply_bytes(self._bus.turns == "multi")
            self.learn_echo([encoder.address or 0 for encoder in encoders], reply_bytes)
        except DeviceError:
            if self._bus.baud == protocol.POWER_UP_BAUD:
                self.recover_baud()
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
                if verdicts[-1] is None:
                    self._drain()  # answers to others than us, or late ones
                if len(verdicts) > 1 and verdicts[-1] is not None and verdicts[-1] == verdicts[-2]:
                    self._echo = verdicts[-1]
                    return
        if received:
            raise DeviceError(
                f"{self._bus.port}: {len(received)} bytes ({received.hex(' ')}) answer a position request; with"
                f" encoder_bus.turns = {self._bus.turns!r} it must be {reply_bytes}, or {reply_bytes + 1} with echo"
            )
        raise DeviceError(f"{self._bus.port}: no encoder answers")

    def recover_baud(self) -> None:
        """Bring encoders that are at the other rate to the profile's; those at the profile's see noise and ignore it.

        An encoder that lost its power is back at 9600 baud; another program may have left one at 115200.
        """
        slow = self._bus.baud == protocol.POWER_UP_BAUD
        with self._guard():
            self._serial.baudrate = protocol.BAUD_CODES[0] if slow else protocol.POWER_UP_BAUD
            self._serial.write(protocol.reset_request() if slow else protocol.fast_baud_request())
            self._serial.flush()
            time.sleep(BAUD_CHANGE_S)
            self._serial.baudrate = self._bus.baud
            self._serial.reset_input_buffer()

    def _drain(self) -> None:
        """Wait for a silence as long as a reply may take."""
        with self._guard():
            deadline = time.monotonic() + DRAIN_S
            while self._serial.read(DRAIN_BYTES) and time.monotonic() < deadline:
                pass

    def _send_and_read(self, request: bytes, length: int) -> tuple[int, bytes]:
        with self._guard():
            self._serial.reset_input_buffer()  # a late reply must not pass for the next
            # Before the write: after it, other threads of the process may hold this one up for long.
            sent_ns = time.monotonic_ns()
            self._serial.write(request)
            return sent_ns, self._serial.read(length)

    @contextlib.contextmanager
    def _guard(self) -> Iterator[None]:
        try:
            yield
        except LOST as error:
            raise DeviceError(f"{self._bus.port}: lost the port: {error}") from error
