"""The encoders' end of an SEI bus, on a pseudo-terminal: what a host meets behind a serial adapter.

In: the true position of every encoder as a function of time. Out: replies at the pace of the wire.

    host            request byte on the wire | 1 ms |
    encoder                            looked ^ each 4 ms, the latest look is the answer
    reply, echo                                     |  hi  |  lo  |

As on the real bus: an encoder looks at its disc each 4 ms, or in strobe mode when it is told to; it starts at 9600 baud
after power-up, and a host that sends at another rate, or something that it does not understand, gets no answer.
"""

import os
import select
import termios
import time
from collections.abc import Callable, Mapping
from pathlib import Path

from rtlog_server.devices.emulated_bus import WATCH_S, EmulatedBus
from rtlog_server.devices.pty_link import PtyLink
from rtlog_server.devices.sei import protocol

BAUD_OF = {termios.B9600: 9600, termios.B115200: 115200}
FIRST_SERIAL_NUMBER = 61000  # of the emulated encoder at address 0


class SeiBusEmulator(EmulatedBus):
    """Encoders on a pseudo-terminal, running from construction to `close()`; a context manager.

    Args:
        link: symbolic link to the terminal, made anew each time; never put over anything but a symbolic link.
        encoders: address → counts per turn.
        position: (address, monotonic ns) → counts over many turns; called in the emulator's thread.
        echo: the adapter returns what it is sent.
        multi_turn: the encoders' mode.
        strobe: the encoders' mode: they latch at a strobe.

    Raises:
        OSError: the link cannot be made.
    """

    def __init__(
        self,
        link: Path,
        encoders: Mapping[int, int],
        position: Callable[[int, int], int],
        echo: bool = False,
        multi_turn: bool = False,
        strobe: bool = False,
    ) -> None:
        super().__init__("SEI emulator")
        self._encoders = dict(encoders)
        self._position = position
        self._echo = echo
        self._multi_turn = multi_turn
        self._strobed_ns: int | None = 0 if strobe else None
        self._baud = dict.fromkeys(self._encoders, protocol.POWER_UP_BAUD)
        self._garbled_replies = 0
        self._wrong_replies = 0
        self._pty = PtyLink(link)
        self.replug()

    # Faults, beside those of every bus

    def power_cycle(self, address: int) -> None:
        """The encoder loses its power for a moment: back at 9600 baud."""
        self._baud[address] = protocol.POWER_UP_BAUD

    def garble(self, replies: int) -> None:
        """The next replies are corrupted on the wire."""
        self._garbled_replies = replies

    def bend(self, replies: int) -> None:
        """The next positions are wrong by a third of a turn, and nothing else shows it."""
        self._wrong_replies = replies

    def babble(self, data: bytes) -> None:
        """Noise on the bus."""
        self._pty.write(data)

    # The thread

    def _plug(self) -> None:
        self._pty.plug()

    def _pull(self) -> None:
        self._pty.unplug()

    def _serve(self) -> None:
        received = bytearray()
        while not self._unplugged.is_set():
            if not select.select([self._pty.master], [], [], WATCH_S)[0]:
                received.clear()  # a command broken off
                continue
            sent = os.read(self._pty.master, 256)
            arriving_ns = time.monotonic_ns()
            host_baud = BAUD_OF.get(self._pty.host_speed(), 0)
            if not host_baud:
                continue
            received += sent
            wire_ns = protocol.wire_ns(len(sent), host_baud)
            if self._echo:
                self._write_at(sent, arriving_ns + wire_ns)
            while (request := protocol.take_request(received)) is not None:
                # requests that were read at once came one after the other all the same
                arrived_ns = arriving_ns + wire_ns - protocol.wire_ns(len(received), host_baud)
                for address in self._addressed(request.address, host_baud):
                    reply = self._answer(address, request, arrived_ns)
                    self._write_paced(reply, arrived_ns, host_baud)

    def _addressed(self, address: int, host_baud: int) -> list[int]:
        present = [known for known in self._encoders if known not in self._muted and self._baud[known] == host_baud]
        return [known for known in present if address in (known, protocol.BROADCAST)]

    def _answer(self, address: int, request: protocol.Request, at_ns: int) -> bytes:
        """The reply; empty to what the encoder does not know."""
        match request:
            case protocol.Request(extended=False, command=protocol.POSITION):
                looked_ns = at_ns - at_ns % protocol.SNAPSHOT_NS if self._strobed_ns is None else self._strobed_ns
                counts = self._position(address, looked_ns)
                if self._wrong_replies > 0:
                    self._wrong_replies -= 1
                    counts += self._encoders[address] // 3
                reply = protocol.encode_position(counts, self._encoders[address], self._multi_turn)
                if self._garbled_replies > 0:
                    self._garbled_replies -= 1
                    return reply[:-2] + b"\xff"  # a byte lost, the other with its bits stuck
                return reply
            case protocol.Request(extended=False, command=protocol.STROBE) if self._strobed_ns is not None:
                self._strobed_ns = at_ns
            case protocol.Request(extended=True, command=protocol.READ_SERIAL_NUMBER):
                return protocol.encode_serial_number(FIRST_SERIAL_NUMBER + address)
            case protocol.Request(extended=True, command=protocol.SET_BAUD, data=data):
                self._baud[address] = protocol.BAUD_CODES.get(data[0], self._baud[address])
            case protocol.Request(extended=True, command=protocol.RESET):
                self._baud[address] = protocol.POWER_UP_BAUD
        return b""

    def _write_paced(self, data: bytes, from_ns: int, baud: int) -> None:
        for index in range(len(data)):
            self._write_at(data[index : index + 1], from_ns + protocol.wire_ns(index + 1, baud))

    def _write_at(self, data: bytes, at_ns: int) -> None:
        while (wait_ns := at_ns - time.monotonic_ns()) > 0:
            time.sleep(wait_ns * 1e-9)
        self._pty.write(data)
