"""An Alien ALR-9650 at the wire: its console over TCP, and the tag stream that it opens to its client.

In: tags as they are read (`read_tag`). Out: what a client of the real reader meets, one console session at a time.

    accept thread     greets, logs in, answers commands; a second client is told to come later
    push thread       connects to TagStreamAddress while TagStreamMode and AutoMode are ON, sends a line a read
"""

import contextlib
import select
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator

from rtlog_server.devices.alien import protocol
from rtlog_server.devices.alien.emulated_reader import EmulatedReader

WATCH_S = 0.02  # how often the threads look whether they are to stop
STREAM_RETRY_S = 0.3
LOGIN_TRIES = 3
BACKLOG_LINES = 10_000  # kept while the stream is not open


class Alr9650Emulator:
    """The reader, powered from construction to `close()`; a context manager.

    Args:
        connect: how it calls its client back for the tag stream: address, time limit in s → socket.

    Attributes:
        port: where the console is.
        busy: fault: another client holds the console.
        silent: fault: the console takes commands but answers nothing.
        refuse_stream: fault: the reader cannot reach its client.
    """

    def __init__(
        self,
        host: str = "127.0.0.1",
        port: int = 0,
        username: str = "alien",
        password: str = "password",
        connect: Callable[[tuple[str, int], float], socket.socket] = socket.create_connection,
    ) -> None:
        self._host = host
        self._login = username, password
        self._connect = connect
        self._reader = EmulatedReader()
        self._changed = threading.Condition()  # guards reader and lines, tells the push thread
        self._lines: deque[str] = deque(maxlen=BACKLOG_LINES)
        self._session = threading.Lock()  # held by the one console session
        self._off = threading.Event()
        self._threads: list[threading.Thread] = []
        self.port = port
        self.busy = False
        self.silent = False
        self.refuse_stream = False
        self.power_on()

    def __enter__(self) -> "Alr9650Emulator":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self.power_off()

    def read_tag(self, epc: str, antenna: int = 0, rssi: float = -40.0, count: int = 1) -> None:
        """A tag in the field is read now; unheard while the reader is not in AutoMode."""
        with self._changed:
            line = self._reader.read_tag(epc, antenna, rssi, count, self._now_ms())
            if line is not None and self._stream_address is not None:
                self._lines.append(line)
                self._changed.notify_all()

    def configure(self, command: str) -> str:
        """Run a command as an earlier client would have; its reply."""
        with self._changed:
            return self._execute(command)

    def power_off(self) -> None:
        """All connections break, nothing listens."""
        self._off.set()
        with self._changed:
            self._changed.notify_all()
        for thread in self._threads:
            thread.join()
        self._threads = []
        self._listener.close()

    def power_on(self) -> None:
        """Boot: settings as they were saved, the clock at 1970, the same port."""
        self._listener = socket.create_server((self._host, self.port))
        self.port = self._listener.getsockname()[1]
        self._reader.power_up()
        self._lines.clear()
        self._booted_ns = time.monotonic_ns()
        self._off.clear()
        self._threads = [threading.Thread(target=work, daemon=True) for work in (self._accept, self._push)]
        for thread in self._threads:
            thread.start()

    # The console

    def _accept(self) -> None:
        sessions: list[threading.Thread] = []
        while not self._off.is_set():
            if not select.select([self._listener], [], [], WATCH_S)[0]:
                continue
            client, _ = self._listener.accept()
            sessions.append(threading.Thread(target=self._serve, args=(client,), daemon=True))
            sessions[-1].start()
        for session in sessions:
            session.join()

    def _serve(self, client: socket.socket) -> None:
        with client, contextlib.suppress(OSError):  # a client that is gone needs no answer
            if self.busy or not self._session.acquire(blocking=False):
                client.sendall(f"{protocol.BUSY}\r\n".encode("ascii"))
                return
            try:
                self._talk(client)
            finally:
                self._session.release()

    def _talk(self, client: socket.socket) -> None:
        lines = self._read_lines(client)
        self._say(client, protocol.encode_prompt(protocol.GREETING))
        for _ in range(LOGIN_TRIES):
            username = next(lines, None)
            self._say(client, protocol.encode_prompt(protocol.PASSWORD_PROMPT))
            if (username, next(lines, None)) == self._login:
                break
            self._say(client, protocol.encode_prompt(f"\r\n{protocol.INVALID_LOGIN}\r\n\r\nUsername>"))
        else:
            return
        self._say(client, protocol.encode_prompt(f"\r\n\r\n{protocol.READY_PROMPT}"))
        for line in lines:
            with self._changed:
                reply = self._execute(line.removeprefix("\x01"))
            if line.startswith("\x01"):
                self._say(client, protocol.encode_reply(reply))
            else:
                self._say(client, protocol.encode_reply(f"{line}\r\n{reply}"))
                self._say(client, protocol.encode_prompt(f"\r\n{protocol.READY_PROMPT}"))
            if reply == protocol.GOODBYE:
                return

    def _read_lines(self, client: socket.socket) -> Iterator[str]:
        """Lines until the client hangs up or falls silent for NetworkTimeout."""
        splitter = protocol.Splitter(b"\n", protocol.MAX_LINE_BYTES)
        heard_s = time.monotonic()
        while not self._off.is_set():
            if time.monotonic() - heard_s > int(self._reader.settings["NetworkTimeout"]):
                self._say(client, protocol.encode_reply("Connection Timeout"))
                return
            if not select.select([client], [], [], WATCH_S)[0]:
                continue
            heard_s = time.monotonic()
            if not (data := client.recv(4096)):
                return
            try:
                yield from (line.rstrip("\r") for line in splitter.feed(data))
            except protocol.AlienError:
                return

    def _say(self, client: socket.socket, data: bytes) -> None:
        if not self.silent:
            client.sendall(data)

    def _execute(self, command: str) -> str:
        reply = self._reader.execute(command, self._now_ms())
        if self._stream_address is None:
            self._lines.clear()
        self._changed.notify_all()
        return reply

    @property
    def _stream_address(self) -> tuple[str, int] | None:
        return None if self.refuse_stream else self._reader.stream_address

    def _now_ms(self) -> int:
        return (time.monotonic_ns() - self._booted_ns) // 1_000_000

    # The tag stream

    def _push(self) -> None:
        stream: socket.socket | None = None
        opened_for: tuple[str, int] | None = None  # a stream that idled out is opened again by the next read only
        sent_s = 0.0
        while not self._off.is_set():
            with self._changed:
                if not self._lines:
                    self._changed.wait(WATCH_S)
                address = self._stream_address
                idle_s = int(self._reader.settings["TagStreamKeepAliveTime"])
            if stream is not None and (address != opened_for or time.monotonic() - sent_s > idle_s or hung_up(stream)):
                stream.close()
                stream = None
            if address is None:
                opened_for = None
                continue
            if stream is None and (address != opened_for or self._lines):
                stream = self._open_stream(address)
                if stream is None:
                    self._off.wait(STREAM_RETRY_S)
                    continue
                opened_for, sent_s = address, time.monotonic()
            if stream is not None and self._lines:
                sent_s = time.monotonic()
                self._send_lines(stream)
        if stream is not None:
            stream.close()

    def _open_stream(self, address: tuple[str, int]) -> socket.socket | None:
        try:
            stream = self._connect(address, 1.0)
        except OSError:
            return None
        if self._reader.settings["StreamHeader"].upper() == "ON":
            header = protocol.encode_stream_header(
                {
                    "ReaderName": self._reader.settings["ReaderName"],
                    "Hostname": "alien-emulator",
                    "IPAddress": stream.getsockname()[0],
                    "CommandPort": str(self.port),
                    "Time": protocol.format_date(self._now_ms()),
                }
            )
            with contextlib.suppress(OSError):
                stream.sendall(f"{header}\r\n".encode("ascii"))
        return stream

    def _send_lines(self, stream: socket.socket) -> None:
        with self._changed:
            lines = list(self._lines)
            self._lines.clear()
        with contextlib.suppress(OSError):  # the next look at the stream finds it hung up
            stream.sendall("".join(f"{line}\r\n" for line in lines).encode("ascii"))


def hung_up(stream: socket.socket) -> bool:
    """Whether the other side closed the stream; it never sends anything."""
    try:
        return bool(select.select([stream], [], [], 0)[0]) and not stream.recv(4096)
    except OSError:
        return True
