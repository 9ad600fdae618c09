"""Alien Reader Protocol: the console's dialogue as bytes and text, both ends. No I/O, no clock.

In: bytes of the console, of a tag stream or of a notification. Out: replies, prompts, lines; and the commands to send.
The law of the console: one command, one reply, and only NUL ends a reply, which may have many lines. A command that
begins with byte 01 is neither echoed nor followed by a prompt. What a reader pushes is lines; `tag_line` reads them.

    host     01 "get ReaderName" CR LF
    reader   "ReaderName = Alien Reader" CR LF NUL

Sources: Alien Technology, "Reader Interface Guide" 8101938-000 (commands, messages); texts of real readers.
"""

import enum
import re
from collections.abc import Mapping, Sequence

MAX_REPLY_BYTES = 1 << 20  # a tag list of some 10 000 tags
MAX_LINE_BYTES = 4096

AUTO_MODE_RESET_DONE = "All auto-mode settings have been reset!"
TAG_LIST_CLEARED = "Tag List has been cleared!"
NOT_UNDERSTOOD = "Error 1: Command not understood."
INVALID_USE = "Error 4: Invalid use of command."
INVALID_LOGIN = "Error: Invalid Username and/or Password"
BUSY = "Another client has the reader. Try again later."
GOODBYE = "Goodbye!"
GREETING = "\r\n".join(["*" * 47, "*", "* Alien Technology : RFID Reader", "*", "*" * 47, "", "Username>"])
PASSWORD_PROMPT = "Password>"
READY_PROMPT = "Alien>"
STREAM_TITLE = "#Alien RFID Reader Tag Stream"
NOTIFICATION_TITLE = "#Alien RFID Reader Auto Notification Message"
NOTIFICATION_END = "#End of Notification Message"


class AlienError(ValueError):
    """Bytes or text that break the protocol."""


class Splitter:
    """Cuts received bytes at any of the terminators; what is not complete yet waits, up to `limit` bytes."""

    def __init__(self, terminators: bytes, limit: int) -> None:
        self._cut = re.compile(b"[" + re.escape(terminators) + b"]")
        self._limit = limit
        self._rest = bytearray()

    @property
    def rest(self) -> str:
        """What came after the last terminator."""
        return self._rest.decode("latin-1")

    def feed(self, data: bytes) -> list[str]:
        """The pieces that are complete now, without their terminators. Raises: AlienError, one grew too long."""
        pieces = []
        first, *others = self._cut.split(data)
        self._rest += first
        for following in others:
            pieces.append(self.rest)
            self._rest = bytearray(following)
        if max(map(len, [*pieces, self._rest])) > self._limit:
            self._rest.clear()
            raise AlienError(f"more than {self._limit} bytes without an end")
        return pieces


def console_splitter() -> Splitter:
    """For replies: NUL ends them."""
    return Splitter(b"\0", MAX_REPLY_BYTES)


def line_splitter() -> Splitter:
    """For tag streams and notifications: lines, some of them empty."""
    return Splitter(b"\r\n\0", MAX_LINE_BYTES)


# The console


class Prompt(enum.Enum):
    USERNAME = enum.auto()
    PASSWORD = enum.auto()
    READY = enum.auto()
    REFUSED = enum.auto()  # wrong user name or password
    BUSY = enum.auto()  # the reader talks to one client at a time


def find_prompt(text: str) -> Prompt | None:
    """What the reader waits for while a client logs in; None: it has not said all yet."""
    if "Error" in text:
        return Prompt.REFUSED
    lines = text.strip().rsplit("\n", 1)
    endings = {"Username>": Prompt.USERNAME, PASSWORD_PROMPT: Prompt.PASSWORD, READY_PROMPT: Prompt.READY}
    found = [prompt for ending, prompt in endings.items() if lines[-1].endswith(ending)]
    return found[0] if found else Prompt.BUSY if "later." in text else None


def login_answer(text: str) -> bytes:
    """User name or password. Raises: AlienError, it is not one line of printable ASCII."""
    if not (text.isascii() and text.isprintable()):
        raise AlienError("user name and password must be printable ASCII")
    return text.encode("ascii") + b"\r\n"


def command(text: str) -> bytes:
    """A command without echo and prompt."""
    return b"\x01" + text.encode("ascii") + b"\r\n"


def is_reply(piece: str) -> bool:
    """Whether this answers a command: it is no prompt, and nothing that the reader says unasked."""
    text = piece.strip()
    return text != READY_PROMPT and not text.startswith(("#Alien RFID", "<Alien-RFID-Reader-Auto"))


def clean_reply(text: str) -> str:
    """The reply without line ends around it and without a prompt that came before it."""
    return text.strip().removeprefix(READY_PROMPT).strip()


def is_error(reply: str) -> bool:
    """Whether the reader refused: an unknown command or setting, a wrong value."""
    return re.match(r"Error\s*\d*:", reply) is not None


def parse_setting(reply: str) -> tuple[str, str]:
    """Name in lower case without its unit, and value, of `Uptime (secs) = 702048`. Raises: AlienError."""
    match = re.fullmatch(r"\s*(\w+)\s*(?:\([^)]*\))?\s*=\s*(.*?)\s*", reply, re.DOTALL)
    if match is None:
        raise AlienError(f"no setting: {reply[:60]!r}")
    return match[1].lower(), match[2]


# The reader's end


def encode_reply(text: str) -> bytes:
    return text.encode("ascii", "replace") + b"\r\n\0"


def encode_prompt(text: str) -> bytes:
    return text.encode("ascii", "replace") + b"\0"


def encode_stream_header(fields: Mapping[str, str]) -> str:
    """The lines with which a tag stream begins."""
    return _with_fields(STREAM_TITLE, fields) + "\r\n"


def encode_notification(fields: Mapping[str, str], tag_lines: Sequence[str]) -> bytes:
    """A whole message, as a reader pushes it to its NotifyAddress."""
    lines = [_with_fields(NOTIFICATION_TITLE, fields), *tag_lines, NOTIFICATION_END]
    return encode_reply("\r\n".join(lines))


def _with_fields(title: str, fields: Mapping[str, str]) -> str:
    return "\r\n".join([title, *(f"#{name}: {value}" for name, value in fields.items())])
