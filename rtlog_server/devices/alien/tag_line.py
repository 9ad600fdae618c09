"""Lines about tags, in every format that readers send them: text → `TagRead` → text. No I/O, no clock.

In: lines of a tag list, a tag stream or a notification. Out: tags; and for the reader's end the lines.

Sources: Alien Technology, "Reader Interface Guide" 8101938-000 (formats); texts of real readers.
"""

import calendar
import math
import re
import time
from dataclasses import dataclass

from rtlog_server.devices.alien.protocol import AlienError

MAX_EPC_DIGITS = 128  # Gen2: 496 bits
TAG_FORMAT = "%k;${MSEC1};${MSEC2};%a;%m;%r"  # EPC, discovered and last seen (ms), antenna, RSSI, reads
NO_TAGS = "(No Tags)"


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
