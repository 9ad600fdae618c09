"""What an ALR-9650 knows and how it answers a command: settings and tag list. No I/O, no clock.

In: command lines and tags in the field, with the reader's time. Out: reply texts and lines for the tag stream.
"""

import re

from rtlog_server.devices.alien import protocol
from rtlog_server.devices.alien.protocol import TagRead

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
    "MaxAntenna": ("1", None),
    "AntennaSequence": ("0", r"\d+(\s*,\s*\d+)*"),
    "RFAttenuation": ("0", NUMBER),
    "RFLevel": ("290", NUMBER),
    "NetworkTimeout": ("90", NUMBER),
    "AcquireMode": ("Inventory", r"Inventory|Global Scroll"),
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
    "AutoMode": ("OFF", ON_OFF),
    "AutoStartPause": ("0", NUMBER),
    "AutoStopTimer": ("0", NUMBER),
}
NAMES = {name.lower(): name for name in SETTINGS}
AUTO_MODE_SETTINGS = ("AutoMode", "AutoStartPause", "AutoStopTimer")


class EmulatedReader:
    """The reader behind its wires. Times are ms of its own clock, which starts in 1970 at each power-up."""

    def __init__(self) -> None:
        self.saved = {name: value for name, (value, _) in SETTINGS.items()}
        self.settings = dict(self.saved)
        self._tags: dict[tuple[str, int], TagRead] = {}

    def power_up(self) -> None:
        """Back to what was saved, with an empty list."""
        self.settings = dict(self.saved)
        self._tags = {}

    @property
    def stream_address(self) -> tuple[str, int] | None:
        """Where to push reads to; None: nowhere now."""
        if not (self._is_on("AutoMode") and self._is_on("TagStreamMode") and self.settings["TagStreamAddress"]):
            return None
        host, port = self.settings["TagStreamAddress"].rsplit(":", 1)
        return host, int(port)

    def read_tag(self, epc: str, antenna: int, rssi: float, count: int, now_ms: int) -> str | None:
        """A tag answers `count` times: the line for the stream; None while the reader does not read by itself."""
        if not self._is_on("AutoMode"):
            return None
        self._forget(now_ms)
        key = epc, 0 if self._is_on("TagListAntennaCombine") else antenna
        before = self._tags.pop(key, None)
        discovered_ms = now_ms if before is None else before.discovered_ms
        tag = TagRead(epc, antenna, count + (before.count if before else 0), rssi, discovered_ms, now_ms)
        self._tags[key] = tag
        return self._format(tag, "TagStream")

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
            case ["get", "time"]:
                return f"Time = {protocol.format_date(now_ms)}"
            case ["get", "uptime"]:
                return f"Uptime (secs) = {now_ms // 1000}"
            case ["t", *_] | ["get", "taglist", *_]:
                return self._tag_list(now_ms)
        if found := re.fullmatch(r"(?:set )?(\w+) ?= ?(.*)", command, re.IGNORECASE):
            return self._set(found[1], found[2])
        if found := re.fullmatch(r"get (\w+)|(\w+) ?\?", command, re.IGNORECASE):
            name = NAMES.get((found[1] or found[2]).lower())
            return f"{name} = {self.settings[name]}" if name else protocol.NOT_UNDERSTOOD
        return protocol.NOT_UNDERSTOOD

    def _set(self, given_name: str, value: str) -> str:
        name = NAMES.get(given_name.lower())
        if name is None:
            return protocol.NOT_UNDERSTOOD
        allowed = SETTINGS[name][1]
        if allowed is None or not re.fullmatch(allowed, value, re.IGNORECASE):
            return protocol.INVALID_USE
        self.settings[name] = value
        return f"{name} = {value}"

    def _tag_list(self, now_ms: int) -> str:
        self._forget(now_ms)
        lines = [self._format(tag, "TagList") for tag in self._tags.values()]
        if int(self.settings["PersistTime"]) == -1:  # a list that is kept until it is read
            self._tags = {}
        return "\r\n".join(lines) or protocol.NO_TAGS

    def _forget(self, now_ms: int) -> None:
        persist_s = int(self.settings["PersistTime"])
        if persist_s >= 0:
            oldest_ms = now_ms - 1000 * persist_s
            self._tags = {key: tag for key, tag in self._tags.items() if (tag.last_seen_ms or 0) >= oldest_ms}

    def _format(self, tag: TagRead, kind: str) -> str:
        list_format = self.settings[f"{kind}Format"].upper()
        return protocol.format_tag(tag, list_format, self.settings[f"{kind}CustomFormat"])

    def _is_on(self, name: str) -> bool:
        return self.settings[name].upper() == "ON"
