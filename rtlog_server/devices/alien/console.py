"""The reader's console as a client sees it: log in, ask, hang up.

In: host, user name, password; or a serial port. Out: replies as clean text. Every way in which a reader can fail to
answer comes out as one DeviceError that names it.

    TCP       greeting, Username>, Password>, then the prompt; one session at a time
    serial    no login; somebody may have left half a command there, so it is called until it answers
"""

import contextlib
import time
from collections import deque

from hw_profiles.profile import RfidDevice
from rtlog_server.devices.alien import protocol
from rtlog_server.devices.alien.link import open_link
from rtlog_server.devices.alien.protocol import AlienError, Prompt
from rtlog_server.devices.device import DeviceError

REPLY_S = 2.0
CALL_S = 0.3  # a serial console is called this often until it answers
QUIET_S = 0.05  # of silence, after which no answer to an earlier call is under way
GOODBYE_S = 0.2


class Console:
    """A session with the reader. Raises, here and in all its methods: DeviceError."""

    def __init__(self, settings: RfidDevice) -> None:
        self._settings = settings
        self._splitter = protocol.console_splitter()
        self._pieces: deque[str] = deque()
        self.link = open_link(settings)
        self._where = self.link.where
        try:
            if self.link.needs_login:
                self._log_in()
            else:
                self._call()
        except AlienError as error:
            self.link.close()
            raise DeviceError(f"{self._where}: {error}") from error
        except DeviceError:
            self.link.close()
            raise

    def ask(self, text: str) -> str:
        """Send a command, wait for its reply; the reader's `Error ...` is a reply too."""
        self.send(text)
        deadline = time.monotonic() + REPLY_S
        while not protocol.is_reply(piece := self._wait_piece(deadline)):
            pass
        return protocol.clean_reply(piece)

    def send(self, text: str) -> None:
        """Send a command; its reply comes out of `receive`."""
        self.link.send(protocol.command(text))

    def receive(self) -> list[str]:
        """Read what is there; the replies that are complete now."""
        self._read(0.0)
        replies = [protocol.clean_reply(piece) for piece in self._pieces if protocol.is_reply(piece)]
        self._pieces.clear()
        return replies

    def close(self) -> None:
        """Say goodbye, that the reader's only session is free at once, and hang up."""
        if self.link.needs_login:  # a serial line has no end
            deadline = time.monotonic() + GOODBYE_S
            with contextlib.suppress(DeviceError):
                self.send("Quit")
                while (left_s := deadline - time.monotonic()) > 0 and self.link.receive(left_s):
                    pass
        self.link.close()

    def _log_in(self) -> None:
        settings, deadline = self._settings, time.monotonic() + REPLY_S
        answers = {Prompt.USERNAME: settings.username, Prompt.PASSWORD: settings.password}
        while (prompt := protocol.find_prompt(self._wait_piece(deadline))) != Prompt.READY:
            if prompt == Prompt.BUSY:
                raise self._busy()
            if prompt == Prompt.REFUSED:
                raise DeviceError(f"{self._where}: the reader refuses user name {settings.username!r} or its password")
            if prompt is not None:
                self.link.send(protocol.login_answer(answers[prompt]))

    def _call(self) -> None:
        deadline = time.monotonic() + REPLY_S
        name = "ReaderName"
        heard = False
        while not heard:
            self.link.send(b"\r\n")  # an end to what stands in the reader's command line
            self.send(f"get {name}")
            call_end = min(time.monotonic() + CALL_S, deadline)
            while not heard and time.monotonic() < call_end:
                self._read(call_end - time.monotonic())
                heard = any(name in piece for piece in self._pieces)
                self._pieces.clear()
            if not heard and time.monotonic() >= deadline:
                raise self._silent()
        while self._read(QUIET_S):
            if time.monotonic() >= deadline:
                raise DeviceError(f"{self._where}: what talks there is no reader")
        self._pieces.clear()

    def _wait_piece(self, deadline: float) -> str:
        while (left_s := deadline - time.monotonic()) > 0:  # also of one that talks without end
            if self._pieces:
                return self._pieces.popleft()
            self._read(left_s)
        raise self._silent()

    def _read(self, timeout_s: float) -> bool:
        """Read once; whether anything came."""
        data = self.link.receive(timeout_s)
        if data is None:
            return False
        if not data:
            last_words = self._splitter.rest.strip()
            if protocol.find_prompt(last_words) == Prompt.BUSY:
                raise self._busy()
            raise DeviceError(f"{self._where}: the reader hung up: {last_words[-80:] or 'no reason given'!r}")
        try:
            pieces = self._splitter.feed(data)
        except AlienError as error:
            raise DeviceError(f"{self._where}: {error}") from error
        if any("Connection Timeout" in piece for piece in pieces):
            raise DeviceError(f"{self._where}: the reader closed the session as idle")
        self._pieces.extend(pieces)
        return True

    def _busy(self) -> DeviceError:
        return DeviceError(f"{self._where}: the reader is busy with another client: try again later")

    def _silent(self) -> DeviceError:
        return DeviceError(f"{self._where}: the reader does not answer")
