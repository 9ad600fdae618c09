"""What an ALR-9650 knows and how it answers a command: settings, clock, tag list, notifications. No I/O.

In: command lines and tags in the field, with the time since power-up. Out: reply texts, lines for the tag stream,
notifications.
"""

import re
from collections.abc import Iterable

from rtlog_server.devices.alien import protocol
from rtlog_server.devices.alien.protocol import AlienError
from rtlog_server.devices.alien.tag_line import NO_TAGS, TagRead, format_date, format_tag, parse_date_ms

ON_OFF = r"ON|OFF"
NUMBER = r"-?\d+"
FORMAT = r"TEXT|TERSE|XML|CUSTOM"
ADDRESS = r"[\w.-]+:\d+"
ANY = r".*"

# Name → value after the first power-up, and the values that it takes; None: read only. Values of a real ALR-9650.
SETTINGS: dict[str, tuple[str, str | None]] = {
    "ReaderName": ("Alien RFID Reader", ANY),
    "ReaderType": ("Alien RFID Tag Reader, Model: ALR-9650 (One Antenna / Gen 2 / 902-928 MHz)", None),
    "ReaderVersion": ("14.07.01.00", None),
    "ReaderNumber": ("255", NUMBER),
    "MACAddress": ("00:1B:5F:00:00:00", None),
    "Function": ("Reader", "Reader|Programmer"),
    "MaxAntenna": ("1", None),
    "AntennaSequence": ("0", r"\d+(\s*,\s*\d+)*"),
    "RFAttenuation": ("0", NUMBER),
    "RFLevel": ("290", NUMBER),
    "NetworkTimeout": ("90", NUMBER),
    "TimeZone": ("0", NUMBER),
    "AcquireMode": ("Inventory", r"Inventory|Global Scroll"),
    "TagType": ("16", NUMBER),
    "AcqG2Mask": ("0", ANY),
    "AcqG2Target": ("A", "A|B|AB"),
    "AcqG2Select": ("1", NUMBER),
    "PersistTime": ("-1", NUMBER),
    "TagListFormat": ("Text", FORMAT),
    "TagListCustomFormat": ("%k", ANY),
    "TagListMillis": ("OFF", ON_OFF),
    "TagListAntennaCombine": ("ON", ON_OFF),
    "StreamHeader": ("OFF", ON_OFF),
    "TagStreamMode": ("OFF", ON_OFF),
    "TagStreamAddress": ("", ADDRESS),
    "TagStreamFormat": ("Text", FORMAT),
    "TagStreamCustomFormat": ("%k", ANY),
    "TagStreamKeepAliveTime": ("30", NUMBER),
    "TagStreamCountFilter": ("0", NUMBER),
    "NotifyMode": ("OFF", ON_OFF),
    "NotifyAddress": ("", ADDRESS),
    "NotifyFormat": ("Text", FORMAT),
    "NotifyHeader": ("ON", ON_OFF),
    "NotifyTime": ("0", NUMBER),
    "NotifyTrigger": ("Off", "Add|True|False|TrueFalse|Off"),
    "NotifyKeepAliveTime": ("30", NUMBER),
    "NotifyRetryCount": ("3", NUMBER),
    "NotifyRetryPause": ("10", NUMBER),
    "AutoMode": ("OFF", ON_OFF),
    "AutoAction": ("Acquire", "None|Acquire"),
    "AutoStartPause": ("0", NUMBER),
    "AutoStopTimer": ("0", NUMBER),
}
NAMES = {name.lower(): name for name in SETTINGS}
AUTO_MODE_SETTINGS = ("AutoMode", "AutoStartPause", "AutoStopTimer")


class EmulatedReader:
    """The reader behind its wires. `now_ms` is the time since power-up, at which its own clock stood at 1970.

    Attributes:
        lacks: names of settings, in lower case, that this reader does not know.
    """

    def __init__(self) -> None:
        self.saved = {name: value for name, (value, _) in SETTINGS.items()}
        self.lacks: set[str] = set()
        self.power_up()

    def power_up(self) -> None:
        """Back to what was saved, with an empty list and the clock at 1970."""
        self.settings = dict(self.saved)
        self._clock_start_ms = 0
        self._tags: dict[tuple[str, int], TagRead] = {}
        self._added: list[tuple[str, int]] = []  # in this read cycle
        self._notified_ms = 0

    def clock_ms(self, now_ms: int) -> int:
        """What its own clock shows, as Unix ms."""
        return self._clock_start_ms + now_ms

    def push_address(self, push: str) -> tuple[str, int] | None:
        """Where `push`, "TagStream" or "Notify", goes; None: nowhere now."""
        if not (self.is_on("AutoMode") and self.is_on(f"{push}Mode") and self.settings[f"{push}Address"]):
            return None
        host, port = self.settings[f"{push}Address"].rsplit(":", 1)
        return host, int(port)

    def is_on(self, name: str) -> bool:
        return self.settings[name].upper() == "ON"

    def read_tag(self, epc: str, antenna: int, rssi: float, count: int, now_ms: int) -> str | None:
        """A tag answers `count` times: the line for the stream; None if it is not read, as without AutoMode."""
        if not self.is_on("AutoMode") or self.settings["AutoAction"] == "None" or self._masked():
            return None
        self._forget(now_ms)
        key = epc, 0 if self.is_on("TagListAntennaCombine") else antenna
        before = self._tags.pop(key, None)
        clock_ms = self.clock_ms(now_ms)
        discovered_ms = clock_ms if before is None else before.discovered_ms
        tag = TagRead(epc, antenna, count + (before.count if before else 0), rssi, discovered_ms, clock_ms)
        self._tags[key] = tag
        if before is None:
            self._added.append(key)
        return self._format(tag, "TagStream")

    def end_cycle(self, now_ms: int) -> str | None:
        """A read cycle is over: the reason to notify, or None; its tags are those of `notified_lines`."""
        added, trigger = bool(self._added), self.settings["NotifyTrigger"].upper()
        triggered = {"ADD": added, "TRUE": added, "FALSE": not added, "TRUEFALSE": True}.get(trigger, False)
        time_s = int(self.settings["NotifyTime"])
        if triggered:
            return "TAGS ADDED" if added else "FALSE"
        if time_s > 0 and now_ms - self._notified_ms >= 1000 * time_s:
            self._notified_ms = now_ms
            return "TIMED MESSAGE"
        self._added = []
        return None

    def notified_lines(self, now_ms: int) -> list[str]:
        """The tags of a notification: those that were added, or all that are listed; begins the next cycle."""
        added, self._added = self._added, []
        keys = added if self.settings["NotifyTrigger"].upper() == "ADD" else list(self._tags)
        self._forget(now_ms)
        return self._list((self._tags[key] for key in keys if key in self._tags), "Notify")

    def execute(self, command: str, now_ms: int) -> str:
        """The reply to a command line."""
        command = " ".join(command.split())
        match command.lower().split():
            case []:
                return ""
            case ["quit"] | ["q"]:
                return protocol.GOODBYE
            case ["automodereset"]:
                self.settings |= {name: SETTINGS[name][0] for name in AUTO_MODE_SETTINGS}
                return protocol.AUTO_MODE_RESET_DONE
            case ["clear", "taglist"]:
                self._tags = {}
                return protocol.TAG_LIST_CLEARED
            case ["save"]:
                self.saved = dict(self.settings)
                return "All settings have been saved!"
            case ["get", "time"] if "time" not in self.lacks:
                return f"Time = {format_date(self.clock_ms(now_ms)).split('.')[0]}"
            case ["get", "uptime"]:
                return f"Uptime (secs) = {now_ms // 1000}"
            case ["t", *_] | ["get", "taglist", *_]:
                return self._tag_list(now_ms)
        if found := re.fullmatch(r"(?:set )?(\w+) ?= ?(.*)", command, re.IGNORECASE):
            return self._set(found[1], found[2], now_ms)
        if found := re.fullmatch(r"get (\w+)|(\w+) ?\?", command, re.IGNORECASE):
            name = self._known(found[1] or found[2])
            return f"{name} = {self.settings[name]}" if name else protocol.NOT_UNDERSTOOD
        return protocol.NOT_UNDERSTOOD

    def _known(self, given_name: str) -> str | None:
        return None if given_name.lower() in self.lacks else NAMES.get(given_name.lower())

    def _set(self, given_name: str, value: str, now_ms: int) -> str:
        if given_name.lower() == "time" and "time" not in self.lacks:
            return self._set_time(value, now_ms)
        name = self._known(given_name)
        if name is None:
            return protocol.NOT_UNDERSTOOD
        allowed = SETTINGS[name][1]
        if allowed is None or not re.fullmatch(allowed, value, re.IGNORECASE):
            return protocol.INVALID_USE
        self.settings[name] = value
        return f"{name} = {value}"

    def _set_time(self, value: str, now_ms: int) -> str:
        try:
            self._clock_start_ms = parse_date_ms(value) - now_ms
        except AlienError:
            return protocol.INVALID_USE
        return f"Time = {value}"

    def _masked(self) -> bool:
        """Whether a mask is set; the emulated tags match none."""
        return re.fullmatch(r"0?|.*,\s*0\s*(,.*)?", self.settings["AcqG2Mask"]) is None

    def _tag_list(self, now_ms: int) -> str:
        self._forget(now_ms)
        lines = self._list(self._tags.values(), "TagList")
        if int(self.settings["PersistTime"]) == -1:  # a list that is kept until it is read
            self._tags = {}
        return "\r\n".join(lines)

    def _forget(self, now_ms: int) -> None:
        persist_s = int(self.settings["PersistTime"])
        if persist_s >= 0:
            oldest_ms = self.clock_ms(now_ms) - 1000 * persist_s
            self._tags = {key: tag for key, tag in self._tags.items() if (tag.last_seen_ms or 0) >= oldest_ms}

    def _list(self, tags: Iterable[TagRead], kind: str) -> list[str]:
        return [self._format(tag, kind) for tag in tags] or [NO_TAGS]

    def _format(self, tag: TagRead, kind: str) -> str:
        list_format = self.settings[f"{kind}Format"].upper()
        custom = self.settings["TagListCustomFormat" if kind == "Notify" else f"{kind}CustomFormat"]
        return format_tag(tag, list_format, custom)
