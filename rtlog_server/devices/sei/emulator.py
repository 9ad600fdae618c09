"""The encoders' end of an SEI bus, on a pseudo-terminal: what a host meets behind a serial adapter.

In: the true position of every encoder as a function of time. Out: replies at the pace of the wire.

    host            request byte on the wire | 1 ms |
    encoder                            looked ^ each 4 ms, the latest look is the answer
    reply, echo                                     |  hi  |  lo  |

As on the real bus: an encoder looks at its disc each 4 ms; it starts at 9600 baud after power-up, and a host that sends
at another rate, or something that it does not understand, gets no answer.
"""

import contextlib
import os
import select
import termios
import threading
import time
import tty
from collections.abc import Callable, Mapping
from pathlib import Path

from rtlog_server.devices.sei import protocol

BAUD_OF = {termios.B9600: 9600, termios.B115200: 115200}
FIRST_SERIAL_NUMBER = 61000  # of the emulated encoder at address 0
WATCH_S = 0.02  # how often the thread looks whether it is to stop


class SeiBusEmulator:
    """Encoders on a pseudo-terminal, running from construction to `close()`; a context manager.

    Args:
        link: symbolic link to the terminal, made anew each time; never put over anything but a symbolic link.
        encoders: address → counts per turn.
        position: (address, monotonic ns) → counts over many turns; called in the emulator's thread.
        echo: the adapter returns what it is sent.
        multi_turn: the encoders' mode.

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
    ) -> None:
        self._link = link
        self._encoders = dict(encoders)
        self._position = position
        self._echo = echo
        self._multi_turn = multi_turn
        self._baud = dict.fromkeys(self._encoders, protocol.POWER_UP_BAUD)
        self._muted: set[int] = set()
        self._garbled_replies = 0
        self._thread: threading.Thread | None = None
        self._unplugged = threading.Event()
        self.replug()

    def __enter__(self) -> "SeiBusEmulator":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self.unplug()

    # Faults

    def mute(self, address: int, muted: bool = True) -> None:
        """The encoder is cut off from the bus, or back."""
        (self._muted.add if muted else self._muted.discard)(address)

    def power_cycle(self, address: int) -> None:
        """The encoder loses its power for a moment: back at 9600 baud."""
        self._baud[address] = protocol.POWER_UP_BAUD

    def garble(self, replies: int) -> None:
        """The next replies are corrupted on the wire."""
        self._garbled_replies = replies

    def unplug(self) -> None:
        """The USB adapter is pulled: the terminal hangs up, its name is gone."""
        if self._thread is None:
            return
        self._unplugged.set()
        self._thread.join()
        self._thread = None
        if self._link.is_symlink() and str(self._link.readlink()) == self._terminal:
            self._link.unlink()
        os.close(self._slave)
        os.close(self._master)

    def replug(self) -> None:
        """The adapter is back under the same link."""
        if self._link.exists() and not self._link.is_symlink():
            raise FileExistsError(f"{self._link} is in the way and no symbolic link")
        self._master, self._slave = os.openpty()  # the slave end stays open: without any, the master reads EIO
        tty.setraw(self._slave)
        self._set_baud_of_power_up()
        self._terminal = os.ttyname(self._slave)
        beside = self._link.with_name(f".{self._link.name}.{os.getpid()}")
        beside.unlink(missing_ok=True)
        beside.symlink_to(self._terminal)
        beside.replace(self._link)
        self._unplugged.clear()
        self._thread = threading.Thread(target=self._serve, name=f"SEI emulator {self._link}", daemon=True)
        self._thread.start()

    # The thread

    def _set_baud_of_power_up(self) -> None:
        attributes = termios.tcgetattr(self._slave)
        attributes[4] = attributes[5] = termios.B9600
        termios.tcsetattr(self._slave, termios.TCSANOW, attributes)

    def _serve(self) -> None:
        received = bytearray()
        while not self._unplugged.is_set():
            if not select.select([self._master], [], [], WATCH_S)[0]:
                received.clear()  # a command broken off
                continue
            sent = os.read(self._master, 256)
            arriving_ns = time.monotonic_ns()
            # A pseudo-terminal has no baud rate of its own, but it remembers the one that the host has set.
            host_baud = BAUD_OF.get(termios.tcgetattr(self._master)[5], 0)
            if not host_baud:
                continue
            received += sent
            arrived_ns = arriving_ns + protocol.wire_ns(len(sent), host_baud)
            if self._echo:
                self._write_at(sent, arrived_ns)
            while (request := protocol.take_request(received)) is not None:
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
                looked_ns = at_ns - at_ns % protocol.SNAPSHOT_NS
                counts = self._position(address, looked_ns)
                reply = protocol.encode_position(counts, self._encoders[address], self._multi_turn)
                if self._garbled_replies > 0:
                    self._garbled_replies -= 1
                    return reply[:-2] + b"\xff"  # a byte lost, the other with its bits stuck
                return reply
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
        with contextlib.suppress(BlockingIOError):  # nobody reads: a wire does not wait
            os.write(self._master, data)
