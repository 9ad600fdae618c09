"""The reader's console as a client sees it: log in, ask, hang up.

In: host, user name, password. Out: replies as clean text. Every way in which a reader can fail to answer comes out as
one DeviceError that names it.
"""

import contextlib
import socket
import time
from collections import deque

from hw_profiles.profile import RfidDevice
from rtlog_server.devices.alien import protocol
from rtlog_server.devices.alien.protocol import AlienError, Prompt
from rtlog_server.devices.device import DeviceError

CONNECT_S = 1.0
REPLY_S = 2.0
GOODBYE_S = 0.2


class Console:
    """A session with the reader. Raises, here and in all its methods: DeviceError."""

    def __init__(self, settings: RfidDevice) -> None:
        self._where = f"{settings.host}:{settings.port}"
        self._splitter = protocol.console_splitter()
        self._pieces: deque[str] = deque()
        try:
            self.socket = socket.create_connection((settings.host, settings.port), CONNECT_S)
        except OSError as error:
            raise DeviceError(f"{self._where}: no connection: {error.strerror or error}") from error
        try:
            self._log_in(settings)
        except AlienError as error:
            self.socket.close()
            raise DeviceError(f"{self._where}: {error}") from error
        except DeviceError:
            self.socket.close()
            raise

    def ask(self, text: str) -> str:
        """Send a command, wait for its reply; the reader's `Error ...` is a reply too."""
        self.send(text)
        deadline = time.monotonic() + REPLY_S
        while (piece := self._wait_piece(deadline)).strip() == protocol.READY_PROMPT:
            pass
        return protocol.clean_reply(piece)

    def send(self, text: str = "") -> None:
        """Send a command; its reply comes out of `receive`."""
        self._send(protocol.command(text))

    def receive(self) -> list[str]:
        """Read what is there, waiting for it if need be; the replies that are complete now."""
        pieces = [piece for piece in self._receive() if piece.strip() != protocol.READY_PROMPT]
        return [protocol.clean_reply(piece) for piece in pieces]

    def close(self) -> None:
        """Say goodbye, that the reader's only session is free at once, and hang up."""
        with contextlib.suppress(OSError, DeviceError):
            self.socket.settimeout(GOODBYE_S)
            self.send("Quit")
            self.socket.shutdown(socket.SHUT_WR)
            while self.socket.recv(1 << 16):
                pass
        self.socket.close()

    def _log_in(self, settings: RfidDevice) -> None:
        deadline = time.monotonic() + REPLY_S
        answers = {Prompt.USERNAME: settings.username, Prompt.PASSWORD: settings.password}
        while (prompt := protocol.find_prompt(self._wait_piece(deadline))) != Prompt.READY:
            if prompt == Prompt.BUSY:
                raise self._busy()
            if prompt == Prompt.REFUSED:
                raise DeviceError(f"{self._where}: the reader refuses user name {settings.username!r} or its password")
            if prompt is not None:
                self._send(protocol.login_answer(answers[prompt]))

    def _wait_piece(self, deadline: float) -> str:
        while not self._pieces:
            left_s = deadline - time.monotonic()
            if left_s <= 0:
                raise DeviceError(f"{self._where}: the reader does not answer")
            self.socket.settimeout(left_s)
            self._pieces.extend(self._receive())
        return self._pieces.popleft()

    def _receive(self) -> list[str]:
        try:
            data = self.socket.recv(1 << 16)
        except OSError as error:
            raise self._lost(error) from error
        if not data:
            last_words = self._splitter.rest.strip()
            if protocol.find_prompt(last_words) == Prompt.BUSY:
                raise self._busy()
            raise DeviceError(f"{self._where}: the reader hung up: {last_words[-80:] or 'no reason given'}")
        try:
            pieces = self._splitter.feed(data)
        except AlienError as error:
            raise DeviceError(f"{self._where}: {error}") from error
        if any("Connection Timeout" in piece for piece in pieces):
            raise DeviceError(f"{self._where}: the reader closed the session as idle")
        return pieces

    def _send(self, data: bytes) -> None:
        try:
            self.socket.sendall(data)
        except OSError as error:
            raise self._lost(error) from error

    def _busy(self) -> DeviceError:
        return DeviceError(f"{self._where}: the reader is busy with another client: try again later")

    def _lost(self, error: OSError) -> DeviceError:
        if isinstance(error, TimeoutError):
            return DeviceError(f"{self._where}: the reader does not answer")
        return DeviceError(f"{self._where}: lost the connection: {error.strerror or error}")
