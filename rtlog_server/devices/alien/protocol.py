"""Alien Reader Protocol: console dialogue and tag lines as bytes and text, both ends. No I/O, no clock.

In: bytes of the console or of a tag stream. Out: replies, prompts, tags; and the commands to send. The law of the
console: one command, one reply, and only NUL ends a reply, which may have many lines. A command that begins with byte
01 is neither echoed nor followed by a prompt.

    host     01 "get ReaderName" CR LF
    reader   "ReaderName = Alien Reader" CR LF NUL

Sources: Alien Technology, "Reader Interface Guide" 8101938-000 (commands, formats); texts of real readers.
"""

import calendar
import enum
import math
import re
import time
from collections.abc import Mapping
from dataclasses import dataclass

MAX_REPLY_BYTES = 1 << 20  # a tag list of some 10 000 tags
MAX_LINE_BYTES = 4096
MAX_EPC_DIGITS = 128  # Gen2: 496 bits

TAG_FORMAT = "%k;${MSEC1};${MSEC2};%a;%m;%r"  # EPC, discovered and last seen (ms), antenna, RSSI, reads
NO_TAGS = "(No Tags)"
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
    """For tag streams, notifications and the reader's end of the console: lines, some of them empty."""
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


def command(text: str = "") -> bytes:
    """A command without echo and prompt; the empty one shows that the reader is alive."""
    return b"\x01" + text.encode("ascii") + b"\r\n"


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


# Tags


@dataclass(frozen=True, slots=True)
class TagRead:
    """One line of a tag list or stream."""

    epc: str  # upper-case hex, no spaces
    antenna: int
    count: int  # reads since the tag came onto the reader's list
    rssi: float  # NaN where the format has none
    discovered_ms: int | None  # when it came onto the list, by the reader's clock
    last_seen_ms: int | None


def parse_tag(line: str) -> TagRead | None:
    """A tag in any of the line formats; None for a line that is none: `#...`, `(No Tags)`, a blank one.

    Custom: `TAG_FORMAT`. Text: `Tag:11C4 00E3, Disc:2003/01/21 09:00:51, Last:..., Count:4, Ant:0, Proto:2`. Terse:
    `11C4 00E3,0,4`; readers send antenna and count, the guide says count and antenna. A count is never 0, so a 0 tells
    which is which; without one the readers are believed.

    Raises:
        AlienError: anything else.
    """
    line = line.strip()
    if not line or line.startswith("#") or line == NO_TAGS:
        return None
    try:
        if line.startswith("Tag:"):
            return _parse_text(line)
        if ";" in line:
            epc, discovered, seen, antenna, rssi, count = line.split(";")
            return _tag(epc, antenna, count, float(rssi or "nan"), int(discovered), int(seen))
        epc, antenna, count = line.split(",")
        if int(count) == 0:
            antenna, count = count, antenna
        return _tag(epc, antenna, count, math.nan, None, None)
    except (ValueError, KeyError) as error:
        raise AlienError(f"no tag: {line[:80]!r}") from error


def _parse_text(line: str) -> TagRead:
    fields = dict(part.strip().split(":", 1) for part in line.split(","))
    seen = [parse_date_ms(fields[key]) if key in fields else None for key in ("Disc", "Last")]
    return _tag(fields["Tag"], fields.get("Ant", "0"), fields.get("Count", "1"), math.nan, seen[0], seen[1])


def parse_date_ms(text: str) -> int:
    """Unix ms of `2003/01/21 09:00:51`, fractions and years of two digits allowed."""
    match = re.fullmatch(r"\s*(\d{2}|\d{4})/(\d\d)/(\d\d) (\d\d):(\d\d):(\d\d)(?:\.(\d{1,3}))?\s*", text, re.ASCII)
    if match is None:
        raise AlienError(f"no date: {text[:40]!r}")
    year, month, day, hour, minute, second = (int(part) for part in match.groups()[:6])
    if not (1 <= month <= 12 and 1 <= day <= 31):
        raise AlienError(f"no date: {text[:40]!r}")
    year += 2000 if len(match[1]) == 2 else 0
    return calendar.timegm((year, month, day, hour, minute, second)) * 1000 + int((match[7] or "0").ljust(3, "0"))


def _tag(epc: str, antenna: str, count: str, rssi: float, discovered: int | None, seen: int | None) -> TagRead:
    epc = epc.replace(" ", "").upper()
    if len(epc) > MAX_EPC_DIGITS or not re.fullmatch(r"[0-9A-F]+", epc):
        raise AlienError(f"no EPC: {epc[:60]!r}")
    tag = TagRead(epc, int(antenna), int(count), rssi, discovered, seen)
    if not (0 <= tag.antenna <= 255 and 1 <= tag.count < 1 << 32 and not math.isinf(rssi)):
        raise AlienError(f"antenna {tag.antenna}, count {tag.count} or RSSI {rssi} is none")
    return tag


# The reader's end


def encode_reply(text: str) -> bytes:
    return text.encode("ascii", "replace") + b"\r\n\0"


def encode_prompt(text: str) -> bytes:
    return text.encode("ascii", "replace") + b"\0"


def format_tag(tag: TagRead, list_format: str, custom_format: str) -> str:
    """A line in format TEXT, TERSE (as readers send it) or CUSTOM, where the tokens of what is known are filled in."""
    grouped = " ".join(tag.epc[start : start + 4] for start in range(0, len(tag.epc), 4))
    if list_format == "TERSE":
        return f"{grouped},{tag.antenna},{tag.count}"
    if list_format == "TEXT":
        times = f"Disc:{format_date(tag.discovered_ms)}, Last:{format_date(tag.last_seen_ms)}"
        return f"Tag:{grouped}, {times}, Count:{tag.count}, Ant:{tag.antenna}, Proto:2"
    tokens = {
        "%k": tag.epc,
        "%i": grouped,
        "%a": str(tag.antenna),
        "%r": str(tag.count),
        "%m": "" if math.isnan(tag.rssi) else f"{tag.rssi:.1f}",
        "${MSEC1}": str(tag.discovered_ms or 0),
        "${MSEC2}": str(tag.last_seen_ms or 0),
    }
    return re.sub(r"%\w|\$\{\w+\}", lambda token: tokens.get(token[0], token[0]), custom_format)


def format_date(unix_ms: int | None) -> str:
    """`1970/03/11 16:06:33.285`"""
    seconds, ms = divmod(unix_ms or 0, 1000)
    return f"{time.strftime('%Y/%m/%d %H:%M:%S', time.gmtime(seconds))}.{ms:03d}"


def encode_stream_header(fields: Mapping[str, str]) -> str:
    """The lines with which a tag stream begins."""
    return "\r\n".join([STREAM_TITLE, *(f"#{name}: {value}" for name, value in fields.items())])
