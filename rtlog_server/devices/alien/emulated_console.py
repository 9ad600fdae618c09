"""The reader's end of a console: greet, log in, answer; over any wire that can send and be watched.

In: a `Wire` and what the reader answers. Out: a whole session, until the client leaves or falls silent.
"""

import os
import select
import socket
import time
from collections.abc import Callable, Iterator
from typing import Protocol

from rtlog_server.devices.alien import protocol
from rtlog_server.devices.pty_link import PtyLink

WATCH_S = 0.02  # how often a thread looks whether it is to stop
LOGIN_TRIES = 3


class Wire(Protocol):
    def fileno(self) -> int: ...
    def send(self, data: bytes) -> None: ...
    def receive(self) -> bytes: ...


class TcpWire:
    """A client's connection."""

    def __init__(self, client: socket.socket) -> None:
        self.fileno = client.fileno
        self.send = client.sendall
        self.receive = lambda: client.recv(4096)


class SerialWire:
    """The device's end of a pseudo-terminal, which outlives the clients at its other end."""

    def __init__(self, pty: PtyLink) -> None:
        self.fileno = lambda: pty.master
        self.send = pty.write
        self.receive = lambda: os.read(pty.master, 4096)


class Session:
    """One client at the console.

    Args:
        execute: command line → reply.
        timeout_s: NetworkTimeout, as it is now; None on a serial line.
        send: what the reader says, on the wire or, by a fault, not.
        stopped: whether the reader lost its power, or its wire.
    """

    def __init__(
        self,
        wire: Wire,
        execute: Callable[[str], str],
        timeout_s: Callable[[], int | None],
        send: Callable[[bytes], None],
        stopped: Callable[[], bool],
    ) -> None:
        self._wire = wire
        self._execute = execute
        self._timeout_s = timeout_s
        self._say = send
        self._stopped = stopped
        self._lines = self._read_lines()

    def log_in(self, login: tuple[str, str]) -> bool:
        """Greet and ask who is there; whether it is someone."""
        self._say(protocol.encode_prompt(protocol.GREETING))
        for _ in range(LOGIN_TRIES):
            username = next(self._lines, None)
            self._say(protocol.encode_prompt(protocol.PASSWORD_PROMPT))
            if (username, next(self._lines, None)) == login:
                self._say(protocol.encode_prompt(f"\r\n\r\n{protocol.READY_PROMPT}"))
                return True
            self._say(protocol.encode_prompt(f"\r\n{protocol.INVALID_LOGIN}\r\n\r\nUsername>"))
        return False

    def answer(self) -> None:
        """Answer commands until the client leaves."""
        for line in self._lines:
            reply = self._execute(line.removeprefix("\x01"))
            if line.startswith("\x01"):
                self._say(protocol.encode_reply(reply))
            else:
                self._say(protocol.encode_reply(f"{line}\r\n{reply}"))
                self._say(protocol.encode_prompt(f"\r\n{protocol.READY_PROMPT}"))
            if reply == protocol.GOODBYE:
                return

    def _read_lines(self) -> Iterator[str]:
        """Lines until the client hangs up or falls silent for too long."""
        splitter = protocol.Splitter(b"\n", protocol.MAX_LINE_BYTES)
        heard_s = time.monotonic()
        while not self._stopped():
            timeout_s = self._timeout_s()
            if timeout_s is not None and time.monotonic() - heard_s > timeout_s:
                self._say(protocol.encode_reply("Connection Timeout"))
                return
            if not select.select([self._wire], [], [], WATCH_S)[0]:
                continue
            heard_s = time.monotonic()
            if not (data := self._wire.receive()):
                return
            try:
                yield from (line.rstrip("\r") for line in splitter.feed(data))
            except protocol.AlienError:
                continue  # what is too long is no command
