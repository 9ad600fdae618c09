"""What the reader is told after each login, whatever state an earlier program left it in.

In: an open console and the address at which we listen. Out: a `Setup` that says how it will tell of tags.

    AutoMode       it reads for ever by itself
    tag stream     it opens a connection to us and sends a line a read
    notify         where it has no tag stream: it sends us its tag list at the end of each read cycle
    tag list       asked for over the console whenever nothing is pushed

A reader may lack some settings, or values of them, and says so: each is then named, and the next best holds. Where two
lines name the same setting, the second is the one that is wanted and the first is what any reader knows.
"""

import time
from dataclasses import dataclass

from rtlog_server.devices.alien import protocol
from rtlog_server.devices.alien.console import Console
from rtlog_server.devices.alien.identity import ask_setting
from rtlog_server.devices.alien.protocol import AlienError
from rtlog_server.devices.alien.tag_line import TAG_FORMAT, parse_date_ms
from rtlog_server.devices.device import DeviceError

CLOCK_TOLERANCE_S = 2.0  # its clock can be set to whole seconds

QUIET = ("AutoMode = OFF", "NotifyMode = OFF", "TagStreamMode = OFF")
READING = (
    ("NetworkTimeout", "30"),  # s; a session that we lost blocks the only console no longer than this
    ("NetworkTimeout", "5"),
    ("Function", "Reader"),
    ("AutoAction", "Acquire"),
    ("AcquireMode", "Inventory"),
    ("TagType", "16"),  # Gen2
    ("Mask", "All"),  # older readers
    ("AcqG2Mask", "0"),  # of length 0: every tag answers
    ("AcqG2Target", "A"),
    ("AcqG2Select", "1"),  # tags that have answered answer again in the next cycle
    ("PersistTime", "5"),  # s that a tag stays on the list: what a poll may come late by
    ("TagListMillis", "ON"),
    ("TagListAntennaCombine", "OFF"),
    ("TagListFormat", "Text"),
    ("TagListFormat", "Custom"),
    ("TagListCustomFormat", TAG_FORMAT),
)
TAG_STREAM = (
    ("StreamHeader", "ON"),
    ("TagStreamFormat", "Text"),
    ("TagStreamFormat", "Custom"),
    ("TagStreamCustomFormat", TAG_FORMAT),
    ("TagStreamCountFilter", "0"),
    ("TagStreamKeepAliveTime", "1800"),  # s that an idle stream stays open
)
NOTIFY = (
    ("NotifyHeader", "ON"),
    ("NotifyFormat", "Text"),
    ("NotifyFormat", "Custom"),  # that of the tag list
    ("NotifyTime", "0"),
    ("NotifyTrigger", "Add"),
    ("NotifyTrigger", "TrueFalse"),  # each read cycle, also one that read nothing
    ("NotifyKeepAliveTime", "30"),
    ("NotifyRetryCount", "-1"),  # for ever
    ("NotifyRetryPause", "1"),  # s
)


@dataclass(frozen=True, slots=True)
class Setup:
    push: str  # "tag stream", "notify" or "" if it can do neither
    refused: tuple[str, ...]  # settings that the reader lacks or would not take
    clock: str  # "right", or what is wrong with it


def set_up(console: Console, push_address: str) -> Setup:
    """Let the reader read and push to `push_address`, "" for nowhere.

    Raises: DeviceError: the console is lost, or the reader will not read by itself.
    """
    for setting in QUIET:
        console.ask(f"set {setting}")
    console.ask("AutoModeReset")
    clock = _set_clock(console)
    refused = _set_all(console, READING)
    push = ""
    if push_address:
        push, refused_push = _set_push(console, push_address)
        refused += refused_push
    console.ask("Clear TagList")  # what it read long ago is nothing that is there now
    reply = console.ask("set AutoMode = ON")
    if protocol.is_error(reply):
        raise DeviceError(f"{console.link.where}: the reader refuses to read by itself (AutoMode = ON): {reply[:80]!r}")
    return Setup(push, tuple(dict.fromkeys(refused)), clock)


def _set_push(console: Console, address: str) -> tuple[str, list[str]]:
    """The tag stream, or notify where there is none."""
    refused: list[str] = []
    for push, settings in (("TagStream", TAG_STREAM), ("Notify", NOTIFY)):
        switches = ((f"{push}Address", address), (f"{push}Mode", "ON"))
        not_switched = _set_all(console, switches)
        refused += not_switched
        if not not_switched:
            return {"TagStream": "tag stream", "Notify": "notify"}[push], refused + _set_all(console, settings)
    return "", refused


def _set_all(console: Console, settings: tuple[tuple[str, str], ...]) -> list[str]:
    """The names of those that were refused."""
    return [name for name, value in settings if protocol.is_error(console.ask(f"set {name} = {value}"))]


def _set_clock(console: Console) -> str:
    """Set the clock to UTC if it is wrong; what is wrong with it then."""
    if _clock_is_right(console):
        return "right"
    console.ask("set TimeZone = 0")
    if not _clock_is_right(console):
        console.ask(f"set Time = {time.strftime('%Y/%m/%d %H:%M:%S', time.gmtime())}")
    return "right" if _clock_is_right(console) else f"{ask_setting(console, 'Time') or 'not told'}, not to be set"


def _clock_is_right(console: Console) -> bool:
    try:
        clock_s = parse_date_ms(ask_setting(console, "Time")) * 1e-3
    except AlienError:
        return False
    return abs(clock_s - time.time()) <= CLOCK_TOLERANCE_S
