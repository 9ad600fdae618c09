"""An slcan adapter (Lawicel ASCII) on a pseudo-terminal, with a bus of its own behind it: the emulator's.

In: frames of the emulated nodes, lines of the host. Out: lines for the host, its frames for the nodes.

    host     C⏎ S6⏎ O⏎                close, 500 kbit/s, open: until then nothing is passed on
    host     t6050840001000000000000⏎ a frame: identifier 605, 8 bytes, the data
    adapter  t5858430010009601020000⏎ a received one; ⏎ alone for done
"""

import contextlib
import os
import select
import time
from pathlib import Path

from rtlog_server.devices.cia406.protocol import Frame
from rtlog_server.devices.pty_link import PtyLink

LONGEST_LINE = 64


class SlcanAdapter:
    """Plugged in from construction to `close()`. Raises: OSError: the link cannot be made, or a file is in its way."""

    def __init__(self, link: Path) -> None:
        self._terminal = PtyLink(link)
        self._received = bytearray()
        self._is_open = False

    def close(self) -> None:
        """The adapter is pulled."""
        self._terminal.unplug()

    def send(self, frame: Frame) -> int:
        """Pass a frame on to the host; one that does not read loses it."""
        if self._is_open:
            self.write(f"t{frame.can_id:03X}{len(frame.data)}{frame.data.hex().upper()}\r".encode())
        return time.monotonic_ns()

    def write(self, data: bytes) -> None:
        """Any bytes to the host."""
        self._terminal.write(data)

    def receive(self, timeout_s: float) -> tuple[Frame, int] | None:
        """The host's next frame and its arrival; None: none came within the time."""
        if self._received.find(b"\r") < 0 and select.select([self._terminal.master], [], [], timeout_s)[0]:
            self._received += os.read(self._terminal.master, 4096)
        text, end, rest = self._received.partition(b"\r")
        if not end:
            del self._received[:-LONGEST_LINE]
            return None
        line, self._received = bytes(text), rest
        self.write(b"\r")
        if line[:1] in (b"O", b"C"):
            self._is_open = line[:1] == b"O"
        if line[:1] != b"t" or not self._is_open:
            return None
        with contextlib.suppress(ValueError):
            data = bytes.fromhex(line[5:].decode("ascii", "replace"))
            return Frame(int(line[1:4], 16), data[: int(line[4:5])]), time.monotonic_ns()
        return None
