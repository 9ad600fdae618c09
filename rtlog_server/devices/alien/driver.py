"""The Alien ALR-9650: set to read for ever and to push each read to us; its console shows that it is alive.

In: the reader's address or serial port from the profile. Out: `TagSample`s as they arrive.

    console        we → reader   log in, `set_up`; then its tag list, and whether it still reads, once a second
    push           reader → us   tag stream or notify; it connects when it likes, at the latest with the first read

While the reader has no connection to us (firewall, wrong `stream_host`, no network on a serial line) its tag list is
asked for at 10 Hz. The list is also the check of a push that died without a word: one that is overtaken by the list
again and again is given up until the reader connects anew. What both tell of a tag counts once.
"""

import selectors
import socket
import time

from hw_profiles.profile import RfidDevice
from rtlog_server.devices.alien import protocol
from rtlog_server.devices.alien.console import Console
from rtlog_server.devices.alien.identity import read_identity
from rtlog_server.devices.alien.listener import PushListener
from rtlog_server.devices.alien.protocol import AlienError
from rtlog_server.devices.alien.setup import Setup, set_up
from rtlog_server.devices.alien.tag_line import parse_tag
from rtlog_server.devices.alien.tag_memory import TagMemory
from rtlog_server.devices.device import Device, DeviceError
from rtlog_server.devices.rfid import TagSample

ALIVE_S = 0.5  # it is asked for something this often: the tag list, or
CHECK_S = 1.0  # whether it still reads by itself: one that was off for a moment, or that someone else has set, does not
SILENT_S = 1.5  # it answers from memory, at once
POLL_S = 0.1  # and this often while nothing can be pushed
COUNTED = ("streams", "strangers refused")
DEAD_PUSH_LISTS = 3  # in succession that told of reads while a connection stood open and told nothing


class Alr9650(Device[TagSample]):
    """The reader. It is read as long as its console answers; what it pushes may come and go."""

    def __init__(self, name: str, settings: RfidDevice) -> None:
        super().__init__(name, stale_after_s=2 * ALIVE_S)
        self._settings = settings
        self._console: Console | None = None
        self._listener: PushListener | None = None
        self._selector: selectors.BaseSelector | None = None
        self._push_address = ""
        self._setup = Setup("", (), "")
        self._memory = TagMemory()
        self._asked_at = self._heard_at = self._checked_at = 0.0
        self._awaiting_reply = False
        self._last_list: list[str] = []
        self._overtaken = 0  # lists in succession that told of reads, and the push did not
        self._garbled, self._last_garbled = 0, "none"

    def connect(self) -> None:
        self._console = console = Console(self._settings)
        identity = read_identity(console, time.time_ns())
        told = {"ReaderName": identity.name, "ReaderType": identity.reader_type, "ReaderVersion": identity.firmware}
        told["MACAddress"] = identity.mac_address
        self.identity = {name: text for name, text in told.items() if text}
        self._selector = selectors.DefaultSelector()
        self._push_address = self._listen(console, self._selector)
        self._setup = set_up(console, self._push_address)
        # Its list was cleared, so its counts begin anew; and a clock set anew, to whole seconds, is off otherwise.
        self._memory = TagMemory()
        self._selector.register(console.link, selectors.EVENT_READ)
        self._awaiting_reply, self._last_list, self._overtaken = False, [], 0
        self._asked_at, self._checked_at = 0.0, time.monotonic()

    def read(self) -> None:
        console, listener, selector = self._console, self._listener, self._selector
        assert console is not None  # connect() made them
        assert selector is not None
        for key, _ in selector.select(POLL_S / 2):
            if key.fileobj is console.link:
                self._take_replies(console)
            elif listener is not None and isinstance(key.fileobj, socket.socket):
                was_open = listener.is_open
                if self._take_lines(listener.receive(key.fileobj)) or listener.is_open != was_open:
                    self._overtaken = 0
        self._keep_asking(console)
        self._tell_health()

    def disconnect(self) -> None:
        for opened in (self._listener, self._selector, self._console):
            if opened is not None:
                opened.close()
        self._console = self._listener = self._selector = None

    @property
    def _pushing(self) -> bool:
        return self._listener is not None and self._listener.is_open

    def _listen(self, console: Console, selector: selectors.BaseSelector) -> str:
        """Open the port that the reader is to push to; its address, "" where the reader has no way to us."""
        host = self._settings.stream_host or console.link.our_host
        if not host:
            return ""
        # Behind an address translation, stream_host is not ours to bind to.
        bound = "" if self._settings.stream_host else host
        self._listener = PushListener(
            bound, self._settings.stream_port, console.link.family, console.link.reader_host, selector
        )
        return f"{host}:{self._listener.port}"

    def _keep_asking(self, console: Console) -> None:
        now = time.monotonic()
        if self._awaiting_reply:
            if now - max(self._asked_at, self._heard_at) > SILENT_S:
                raise DeviceError(f"{console.link.where}: the reader has been silent for {SILENT_S:.1f} s")
        elif now - self._asked_at >= (ALIVE_S if self._pushing else POLL_S):
            check = now - self._checked_at >= CHECK_S
            console.send("get AutoMode" if check else "get TagList")
            self._asked_at, self._awaiting_reply = now, True
            self._checked_at = now if check else self._checked_at

    def _take_replies(self, console: Console) -> None:
        replies = console.receive()
        self._heard_at = time.monotonic()
        for reply in replies:
            self._awaiting_reply = False
            self.heard()
            if reply.casefold().startswith("automode"):
                if reply.casefold().endswith("off"):
                    raise DeviceError(f"{console.link.where}: the reader no longer reads by itself: it is set up anew")
            elif not protocol.is_error(reply) and self._take_list(reply.removeprefix("TagList =").split("\n")):
                self._overtaken += 1
        if self._listener is not None and self._overtaken >= DEAD_PUSH_LISTS:
            self._listener.drop_all()

    def _take_list(self, lines: list[str]) -> bool:
        """Hand over what nothing else told; whether there was any. A push has time to tell it until the next list."""
        late, self._last_list = self._last_list, lines
        return self._take_lines(late if self._pushing else lines)

    def _take_lines(self, lines: list[str]) -> bool:
        """Hand over what is new in them; whether anything was."""
        receive_ns = time.monotonic_ns()
        news = False
        for line in lines:
            try:
                tag = parse_tag(line)
            except AlienError as error:
                self._garbled += 1
                self._last_garbled = str(error)
                continue
            sample = None if tag is None else self._memory.take(tag, receive_ns)
            if sample is not None:
                self.hand_over(sample)
                news = True
        return news

    def _tell_health(self) -> None:
        listener, setup = self._listener, self._setup
        unheard = listener is not None and not listener.is_open and self._overtaken > 0
        if unheard:
            self.message = f"the reader opens no tag stream to {self._push_address}: polling its tag list"
        else:
            self.message = "connected"
        clock = setup.clock if self._memory.clock.right else "wrong"
        self.diagnostics = {
            "stream": "open" if self._pushing else "polling",
            "push": setup.push or "none",
            "stream address": self._push_address or "none",
            "refused settings": ", ".join(setup.refused) or "none",
            "clock": clock if clock == "right" else f"{clock}; stamps are the host's",
            **{event: str((listener.tally if listener else {}).get(event, 0)) for event in COUNTED},
            "garbled": str(self._garbled),
            "last garbled": (listener.last_garbled if listener else "") or self._last_garbled,
        }
