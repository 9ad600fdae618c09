"""The Alien ALR-9650: set to read for ever and to push each read to us; its console shows that it is alive.

In: the reader's address from the profile. Out: `TagSample`s as they arrive.

    console        we → reader   log in, settings; then an empty command a second
    tag stream     reader → us   a line a read; the reader opens it when it likes, at the latest with the first read

A reader that cannot reach us (firewall, wrong `stream_host`) never opens its stream: then its tag list is polled over
the console until it does. What both tell of a tag counts once.
"""

import selectors
import socket
import time
from collections import Counter

from hw_profiles.profile import RfidDevice
from rtlog_server.devices.alien import protocol
from rtlog_server.devices.alien.console import REPLY_S, Console
from rtlog_server.devices.alien.identity import read_identity
from rtlog_server.devices.alien.protocol import TAG_FORMAT, AlienError, TagRead
from rtlog_server.devices.device import Device, DeviceError
from rtlog_server.devices.rfid import TagSample

ALIVE_S = 1.0  # an empty command this often
STREAM_WAIT_S = 3.0  # without a stream the tag list is polled
POLL_S = 0.1
MAX_TAGS = 4096  # the reads of so many tags are kept apart

# Whatever an earlier program left, this is what the reader does next. A reader may lack some and say so.
SETTINGS = (
    ("NetworkTimeout", "30"),  # s; a session that we lost blocks the only console no longer than this
    ("NotifyMode", "OFF"),
    ("AcquireMode", "Inventory"),
    ("PersistTime", "5"),  # s that a tag stays on the list: what a poll may come late by
    ("TagListMillis", "ON"),
    ("TagListAntennaCombine", "OFF"),
    ("TagListFormat", "Custom"),
    ("TagListCustomFormat", TAG_FORMAT),
    ("StreamHeader", "ON"),
    ("TagStreamFormat", "Custom"),
    ("TagStreamCustomFormat", TAG_FORMAT),
    ("TagStreamCountFilter", "0"),
    ("TagStreamKeepAliveTime", "1800"),  # s that an idle stream stays open
)


class Alr9650(Device[TagSample]):
    """The reader. It is read as long as its console answers; the stream may come and go."""

    def __init__(self, name: str, settings: RfidDevice) -> None:
        super().__init__(name, stale_after_s=2 * ALIVE_S)
        self._settings = settings
        self._console: Console | None = None
        self._listener: socket.socket | None = None
        self._stream: socket.socket | None = None
        self._selector: selectors.BaseSelector | None = None
        self._lines = protocol.line_splitter()
        self._stream_address = ""
        self._refused_settings = ""
        self._no_stream_since = 0.0
        self._asked_at = 0.0
        self._awaiting_reply = False
        self._seen: dict[tuple[str, int], TagRead] = {}
        self._tally: Counter[str] = Counter()
        self._last_garbled = "none"

    def connect(self) -> None:
        self._console = console = Console(self._settings)
        self._listener = listener = self._listen(console.socket)
        host = self._settings.stream_host or console.socket.getsockname()[0]
        self._stream_address = f"{host}:{listener.getsockname()[1]}"
        identity = read_identity(console, time.time_ns())
        told = {"ReaderName": identity.name, "ReaderType": identity.reader_type, "ReaderVersion": identity.firmware}
        told["MACAddress"] = identity.mac_address
        self.identity = {name: text for name, text in told.items() if text}
        self._configure(console)
        self._selector = selectors.DefaultSelector()
        self._selector.register(console.socket, selectors.EVENT_READ)
        self._selector.register(listener, selectors.EVENT_READ)
        self._awaiting_reply = False
        self._asked_at = self._no_stream_since = time.monotonic()

    def read(self) -> None:
        console, listener, selector = self._console, self._listener, self._selector
        assert console is not None  # connect() made all of them
        assert listener is not None
        assert selector is not None
        for key, _ in selector.select(POLL_S):
            if key.fileobj is console.socket:
                self._take_replies(console)
            elif key.fileobj is listener:
                self._accept(listener, console.socket.getpeername()[0], selector)
            elif key.fileobj is self._stream:  # and not one that was replaced just now
                self._take_stream(self._stream, selector)
        self._keep_asking(console)

    def disconnect(self) -> None:
        for opened in (self._console, self._stream, self._listener, self._selector):
            if opened is not None:
                opened.close()
        self._console = self._stream = self._listener = self._selector = None

    # Setting up

    def _listen(self, console: socket.socket) -> socket.socket:
        # Behind an address translation, stream_host is not ours to bind to.
        host = "" if self._settings.stream_host else console.getsockname()[0]
        try:
            listener = socket.create_server((host, self._settings.stream_port), family=console.family)
        except OSError as error:
            raise DeviceError(f"stream_port {self._settings.stream_port}: cannot listen: {error.strerror}") from error
        listener.setblocking(False)
        return listener

    def _configure(self, console: Console) -> None:
        refused = []
        console.ask("set AutoMode = OFF")
        console.ask("set TagStreamMode = OFF")
        console.ask("AutoModeReset")
        console.ask("Clear TagList")  # what it read long ago is nothing that is there now
        address = ("TagStreamAddress", self._stream_address)
        for name, value in (*SETTINGS, address, ("TagStreamMode", "ON")):
            if protocol.is_error(console.ask(f"set {name} = {value}")):
                refused.append(name)
        reply = console.ask("set AutoMode = ON")
        if protocol.is_error(reply):
            raise DeviceError(f"{self._settings.host}: the reader refuses to read by itself (AutoMode = ON): {reply}")
        self._refused_settings = ", ".join(refused) or "none"

    # The console

    def _keep_asking(self, console: Console) -> None:
        """Ask for the tag list while there is no stream, for nothing once a second: the answer is the sign of life."""
        now = time.monotonic()
        if self._awaiting_reply:
            if now - self._asked_at > REPLY_S:
                raise DeviceError(f"{self._settings.host}: the reader has been silent for {REPLY_S:.0f} s")
            return
        polling = self._stream is None and now - self._no_stream_since > STREAM_WAIT_S
        if now - self._asked_at >= (POLL_S if polling else ALIVE_S):
            console.send("get TagList" if polling else "")
            self._asked_at, self._awaiting_reply = now, True
        self._tell_health(polling)

    def _take_replies(self, console: Console) -> None:
        for reply in console.receive():
            self._awaiting_reply = False
            self.heard()
            if not protocol.is_error(reply):
                self._take_lines(reply.removeprefix("TagList =").split("\n"))

    # The stream

    def _accept(self, listener: socket.socket, reader: str, selector: selectors.BaseSelector) -> None:
        try:
            stream, (peer, *_) = listener.accept()
        except OSError:
            return  # gone again
        if peer != reader:
            self._tally["strangers refused"] += 1
            stream.close()
            return
        self._drop_stream(selector)  # a reader that opens another has given up the last
        stream.setblocking(False)
        selector.register(stream, selectors.EVENT_READ)
        self._stream, self._lines = stream, protocol.line_splitter()
        self._tally["streams"] += 1

    def _take_stream(self, stream: socket.socket, selector: selectors.BaseSelector) -> None:
        try:
            data = stream.recv(1 << 16)
            lines = self._lines.feed(data)
        except BlockingIOError:
            return
        except (OSError, AlienError) as error:
            self._last_garbled = str(error)
            self._drop_stream(selector)
            return
        if not data:
            self._drop_stream(selector)
        self._take_lines(lines)

    def _drop_stream(self, selector: selectors.BaseSelector) -> None:
        if self._stream is not None:
            selector.unregister(self._stream)
            self._stream.close()
            self._stream = None
            self._no_stream_since = time.monotonic()

    # Tags

    def _take_lines(self, lines: list[str]) -> None:
        now_ns = time.monotonic_ns()
        for line in lines:
            try:
                tag = protocol.parse_tag(line)
            except AlienError as error:
                self._tally["garbled"] += 1
                self._last_garbled = str(error)
                continue
            if tag is not None and (reads := self._new_reads(tag)):
                sample = TagSample(now_ns, now_ns, tag.epc, tag.antenna, reads, tag.rssi, tag.last_seen_ms)
                self.hand_over(sample)

    def _new_reads(self, tag: TagRead) -> int:
        """How many reads a line adds to what was told of this tag: readers count on while a tag is on their list."""
        key = tag.epc, tag.antenna
        before = self._seen.get(key)
        if before is not None and tag.discovered_ms == before.discovered_ms:
            times = tag.last_seen_ms, before.last_seen_ms
            if times[0] is not None and times[1] is not None and (times[0], tag.count) <= (times[1], before.count):
                return 0  # told already
            reads = tag.count - before.count if tag.count > before.count else tag.count
        else:
            reads = tag.count
        self._seen.pop(key, None)
        self._seen[key] = tag  # at the end: the longest unread goes first
        if len(self._seen) > MAX_TAGS:
            del self._seen[next(iter(self._seen))]
        return reads

    def _tell_health(self, polling: bool) -> None:
        if polling:
            self.message = f"the reader opens no tag stream to {self._stream_address}: polling its tag list"
        else:
            self.message = "connected"
        self.diagnostics = {
            "stream": "open" if self._stream is not None else "polling" if polling else "waiting",
            "stream address": self._stream_address,
            "refused settings": self._refused_settings,
            **{event: str(self._tally[event]) for event in ("streams", "strangers refused", "garbled")},
            "last garbled": self._last_garbled,
        }
