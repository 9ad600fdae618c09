"""An Alien ALR-9650 at the wire: its console over TCP and RS-232, and what it pushes to its client.

In: tags as they are read (`read_tag`). Out: what a client of the real reader meets, one TCP session at a time.

    accept thread     a thread for each client: greets, logs in, answers commands; a second client is told to come later
    serial thread     answers commands without a login, on a pseudo-terminal
    push thread       tag stream: a line a read; notify: at the end of each read cycle. Both while AutoMode is ON
"""

import contextlib
import select
import socket
import struct
import threading
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path

from rtlog_server.devices.alien import protocol
from rtlog_server.devices.alien.emulated_console import WATCH_S, SerialWire, Session, TcpWire, Wire
from rtlog_server.devices.alien.emulated_push import Connect, Push
from rtlog_server.devices.alien.emulated_reader import EmulatedReader
from rtlog_server.devices.alien.tag_line import format_date
from rtlog_server.devices.pty_link import PtyLink

CYCLE_S = 0.1  # a read cycle
BACKLOG_LINES = 10_000  # kept while the stream is not open
CUT_S = 0.001  # between the two pieces of what is cut
RESET_ON_CLOSE = struct.pack("ii", 1, 0)  # SO_LINGER


class Alr9650Emulator:
    """The reader, powered from construction to `close()`; a context manager.

    Args:
        link: symbolic link to a pseudo-terminal with the serial console; None: nothing is plugged in there.
        connect: how it calls its client back for a push: address, time limit in s → socket.

    Attributes:
        port: where the console is.
        busy: fault: another client holds the console.
        silent: fault: the console takes commands but answers nothing.
        refuse_stream: fault: the reader cannot reach its client.
        cut: fault: whatever is sent arrives in two pieces.
        swallow_push: fault: what is pushed never arrives, though the connection stands.
        lacks: names of settings, in lower case, that this reader does not know; also "time".

    Raises:
        OSError: the port is taken, or the link cannot be made.
    """

    def __init__(
        self,
        host: str = "127.0.0.1",
        port: int = 0,
        username: str = "alien",
        password: str = "password",
        connect: Connect = socket.create_connection,
        link: Path | None = None,
    ) -> None:
        self._host = host
        self._login = username, password
        self._connect = connect
        self._reader = EmulatedReader()
        self._changed = threading.Condition()  # guards reader and lines, tells the push thread
        self._lines: deque[str] = deque(maxlen=BACKLOG_LINES)
        self._clients: set[socket.socket] = set()
        self._session = threading.Lock()  # held by the one console session
        self._off = threading.Event()
        self._threads: list[threading.Thread] = []
        self._pty = PtyLink(link) if link is not None else None
        self._unplugged = threading.Event()
        self._serial_thread: threading.Thread | None = None
        self.port = port
        self.busy = False
        self.silent = False
        self.refuse_stream = False
        self.cut = False
        self.swallow_push = False
        self.lacks = self._reader.lacks
        try:
            self.power_on()
        except OSError:
            self.unplug()
            raise

    def __enter__(self) -> "Alr9650Emulator":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self.power_off()
        self.unplug()

    def read_tag(self, epc: str, antenna: int = 0, rssi: float = -40.0, count: int = 1) -> None:
        """A tag in the field is read now; unheard while the reader is not in AutoMode."""
        with self._changed:
            line = self._reader.read_tag(epc, antenna, rssi, count, self._now_ms())
            if line is not None and self._push_address("TagStream") is not None:
                self._lines.append(line)
                self._changed.notify_all()

    def configure(self, command: str) -> str:
        """Run a command as an earlier client would have; its reply."""
        with self._changed:
            reply = self._reader.execute(command, self._now_ms())
            if self._push_address("TagStream") is None:
                self._lines.clear()
            self._changed.notify_all()
            return reply

    # Power and wires

    def power_off(self) -> None:
        """All connections break, nothing listens, the serial console is dumb."""
        self._off.set()
        with self._changed:
            self._changed.notify_all()
        for thread in self._threads:
            thread.join()
        self._threads = []
        self._join_serial()
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
        self._start_serial()

    def unplug(self) -> None:
        """The USB adapter of the serial console is pulled."""
        if self._pty is not None:
            self._unplugged.set()
            self._join_serial()
            self._pty.unplug()

    def replug(self) -> None:
        """The adapter is back under its stable name."""
        if self._pty is not None:
            self._pty.plug()
            self._unplugged.clear()
            self._start_serial()

    def _start_serial(self) -> None:
        if self._pty is not None and not self._unplugged.is_set() and not self._off.is_set():
            self._pty.flush()
            self._serial_thread = threading.Thread(target=self._serve_serial, args=(self._pty,), daemon=True)
            self._serial_thread.start()

    def _join_serial(self) -> None:
        if self._serial_thread is not None:
            self._serial_thread.join()
            self._serial_thread = None

    def reset_connections(self) -> None:
        """Every client's connection is reset, as by a router that forgot it."""
        for client in list(self._clients):
            with contextlib.suppress(OSError):
                client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, RESET_ON_CLOSE)
                client.close()

    def babble(self, data: bytes) -> None:
        """Send this to every client of the console, between whatever it is that the reader answers."""
        for client in list(self._clients):
            with contextlib.suppress(OSError):
                client.sendall(data)
        if self._pty is not None:
            self._pty.write(data)

    # The consoles

    def _accept(self) -> None:
        sessions: list[threading.Thread] = []
        while not self._off.is_set():
            if not select.select([self._listener], [], [], WATCH_S)[0]:
                continue
            client, _ = self._listener.accept()
            sessions = [session for session in sessions if session.is_alive()]
            sessions.append(threading.Thread(target=self._serve, args=(client,), daemon=True))
            sessions[-1].start()
        for session in sessions:
            session.join()

    def _serve(self, client: socket.socket) -> None:
        with client, contextlib.suppress(OSError, ValueError):  # a client that is gone needs no answer
            if self.busy or not self._session.acquire(blocking=False):
                client.sendall(f"{protocol.BUSY}\r\n".encode("ascii"))
                return
            self._clients.add(client)
            try:
                session = self._new_session(TcpWire(client), lambda: int(self._reader.settings["NetworkTimeout"]))
                if session.log_in(self._login):
                    session.answer()
            finally:
                self._clients.discard(client)
                self._session.release()

    def _serve_serial(self, pty: PtyLink) -> None:
        self._new_session(SerialWire(pty), lambda: None).answer()

    def _new_session(self, wire: Wire, timeout_s: Callable[[], int | None]) -> Session:
        def stopped() -> bool:
            return self._off.is_set() or (self._unplugged.is_set() and isinstance(wire, SerialWire))

        def say(data: bytes) -> None:
            if not self.silent:
                self._send(wire.send, data)

        return Session(wire, self.configure, timeout_s, say, stopped)

    def _send(self, send: Callable[[bytes], None], data: bytes) -> None:
        middle = len(data) // 2
        if self.cut:
            send(data[:middle])
            time.sleep(CUT_S)
            data = data[middle:]
        send(data)

    # What it pushes

    def _push_address(self, push: str) -> tuple[str, int] | None:
        return None if self.refuse_stream else self._reader.push_address(push)

    def _push(self) -> None:
        stream = Push(self._connect, self._send, self._stream_header)
        notify = Push(self._connect, self._send, lambda _: b"")
        cycle_end_s = time.monotonic()
        while not self._off.is_set():
            with self._changed:
                if not self._lines:
                    self._changed.wait(WATCH_S)
                address, notify_address = self._push_address("TagStream"), self._push_address("Notify")
                idle_s = int(self._reader.settings["TagStreamKeepAliveTime"])
                notify_idle_s = int(self._reader.settings["NotifyKeepAliveTime"])
                message = b""
                if notify_address is not None and time.monotonic() - cycle_end_s > CYCLE_S:
                    cycle_end_s = time.monotonic()
                    message = self._notification()
                if self.swallow_push:
                    self._lines.clear()
                    message = b""
                lines = list(self._lines)
            data = "".join(f"{line}\r\n" for line in lines).encode("ascii")
            if stream.serve(address, data, idle_s, eager=True):
                with self._changed:
                    for _ in range(min(len(lines), len(self._lines))):
                        self._lines.popleft()
            elif lines:
                self._off.wait(WATCH_S)
            notify.serve(notify_address, message, notify_idle_s, eager=False)
        stream.close()
        notify.close()

    def _notification(self) -> bytes:
        reason = self._reader.end_cycle(self._now_ms())
        if reason is None:
            return b""
        fields = {**self._names(), "Time": self._date(), "Reason": reason}
        header_on = self._reader.is_on("NotifyHeader")
        return protocol.encode_notification(fields if header_on else {}, self._reader.notified_lines(self._now_ms()))

    def _stream_header(self, stream: socket.socket) -> bytes:
        if not self._reader.is_on("StreamHeader"):
            return b""
        fields = {**self._names(), "IPAddress": stream.getsockname()[0], "Time": self._date()}
        return protocol.encode_stream_header(fields).encode("ascii")

    def _names(self) -> dict[str, str]:
        return {"ReaderName": self._reader.settings["ReaderName"], "CommandPort": str(self.port)}

    def _date(self) -> str:
        return format_date(self._reader.clock_ms(self._now_ms()))

    def _now_ms(self) -> int:
        return (time.monotonic_ns() - self._booted_ns) // 1_000_000
