"""The telegrams of a SICK LMS111, both directions: commands, replies, events. No I/O, no clock.

In: a payload as `cola.Receiver` cuts it. Out: a `Reply` or a `ScanData`; and the bytes of any of them. A telegram says
nothing of what came before it, but for an error, which does not name the command that it answers: the host must have
only one command under way.

    host     sRN name          sWN name values    sMN name values    sEN name on
    device   sRA name values   sWA name           sAN name values    sEA name on     sSN name values (event)    sFA code

Source: SICK Telegram Listing 8014631, §4; LMS500 operating instructions 8013796, §10.2; captured sessions of an LMS111.
"""

from dataclasses import dataclass
from typing import Any

from rtlog_server.devices.lms111.cola import Dialect, frame, split_command
from rtlog_server.devices.lms111.fields import Reader, open_reader, open_writer
from rtlog_server.devices.lms111.scan_data import ScanData, read_scan_data

AUTHORISED_CLIENT = (3, 0xF4724744)  # level, and the hash of its factory password

SCAN_CONFIGURATION = "IHIii"  # frequency 1/100 Hz, number of sectors, resolution, start, stop in 1/10000°
OUTPUT_RANGE = "HIii"  # number of sectors, resolution, start, stop in 1/10000°
# Echoes (2), remission, its resolution (0: 8 bit, 1: 16 bit), its unit, encoder (2), position, name, comment, time,
# every nth scan:
SCAN_CONTENT = "BBBBBBBBBBBH"

# The values of each telegram in the letters of `fields`, `s` for a text; what is not here has none that we know.
LAYOUTS = {
    "sFA": "H",
    "sMN SetAccessMode": "BI",
    "sAN SetAccessMode": "B",  # 1: granted
    "sAN Run": "B",
    "sAN LMCstartmeas": "B",  # 0: done
    "sAN LMCstopmeas": "B",
    "sAN LMCstandby": "B",
    "sAN mEEwriteall": "B",
    "sMN mLMPsetscancfg": SCAN_CONFIGURATION,
    "sAN mLMPsetscancfg": "B" + SCAN_CONFIGURATION,  # 0: done
    "sRA LMPscancfg": SCAN_CONFIGURATION,
    "sRA LMPoutputRange": OUTPUT_RANGE,
    "sWN LMPoutputRange": OUTPUT_RANGE,
    "sRA LMDscandatacfg": SCAN_CONTENT,
    "sWN LMDscandatacfg": SCAN_CONTENT,
    "sRA STlms": "BBssHHH",  # state, 1: outside of its temperature range, time, date, LEDs
    "sRA SCdevicestate": "B",  # 0: busy or logged in, 1: ready, 2: error
    "sRA LCMstate": "B",
    "sRA DeviceIdent": "ss",
    "sRA FirmwareVersion": "s",
    "sRA LocationName": "s",
    "sRA ODoprh": "I",  # operating time in 0.1 h
    "sRA ODpwrc": "I",  # times powered on
    "sMN LSPsetdatetime": "HBBBBBI",
    "sAN LSPsetdatetime": "B",
    "sRA EIHstCola": "B",  # 0: CoLa A, 1: CoLa B, from the next connection on
    "sWN EIHstCola": "B",
    "sEN LMDscandata": "B",
    "sEA LMDscandata": "B",
    "sEN LFErec": "B",
    "sEA LFErec": "B",
    "sEN LIDinputstate": "B",
    "sEA LIDinputstate": "B",
    "sEN LIDoutputstate": "B",
    "sEA LIDoutputstate": "B",
}

SCAN_CONFIGURATION_FAULTS = {1: "frequency", 2: "resolution", 3: "frequency and resolution", 4: "sector", 5: "other"}

STATES = {
    0: "undefined",
    1: "initialising",
    2: "in configuration",
    3: "idle",
    4: "rotating",
    5: "in preparation",
    6: "ready",
    7: "measuring",
}
INITIALISING, IDLE, IN_PREPARATION, MEASURING = 1, 3, 5, 7

ACCESS_DENIED, UNKNOWN_METHOD, UNKNOWN_VARIABLE, CONDITION_FAILED, INVALID_DATA, WRITE_PROTECTED = 1, 2, 3, 4, 5, 10
ERRORS = {  # of sFA
    1: "access denied at this level",
    2: "unknown method",
    3: "unknown variable",
    4: "local condition failed",
    5: "invalid data",
    6: "unknown error",
    7: "too much data",
    8: "too little data",
    9: "unknown type",
    10: "variable is write-protected",
    11: "unknown command for the name server",
    12: "unknown CoLa command",
    13: "busy",
    14: "index out of bounds",
    15: "unknown event",
    16: "value too large",
    17: "invalid character",
    18: "no internal message",
    19: "no internal answer",
    20: "internal error",
    21: "hub address too short or too long",
    22: "hub address cannot be decoded",
    23: "too many hubs in the address",
    24: "blank expected in the hub address",
    25: "asynchronous methods are suppressed",
    32: "complex arrays not supported",
    33: "no resources for a session",
    34: "unknown session",
    35: "cannot connect",
    36: "invalid port",
    37: "scan already active",
    38: "out of timers",
    39: "write mode not enabled",
}

DEVICE_ERROR = 2  # of SCdevicestate
CONTAMINATION = {1: "front window is dirty", 2: "front window is too dirty", 3: "front window is very dirty"}

REPLY_VERBS = {"sRN": "sRA", "sWN": "sWA", "sMN": "sAN", "sEN": "sEA"}


@dataclass(frozen=True, slots=True)
class Command:
    """Any telegram but LMDscandata: `name` with its verb, as in `sRA LMPscancfg`."""

    name: str
    values: tuple[Any, ...] = ()


def state_name(state: int) -> str:
    """What STlms says, in words that follow "it is"."""
    return STATES.get(state, f"in state {state}")


def reply_name(command: str) -> str:
    """`sRA LMPscancfg` for `sRN LMPscancfg`."""
    return REPLY_VERBS[command[:3]] + command[3:]


def encode_command(dialect: Dialect, command: str, *values: Any) -> bytes:
    """A telegram ready for the wire, `encode_command(Dialect.B, "sEN LMDscandata", 1)`.

    Raises:
        ValueError, struct.error: the values are not those of the command.
    """
    writer = open_writer(dialect, command)
    layout = LAYOUTS.get(command, "")
    for code, value in zip(layout, values, strict=True):
        if code == "s":
            writer.text(value)
        else:
            writer.put(code, value)
    return frame(dialect, writer.payload())


def decode(dialect: Dialect, payload: bytes) -> Command | ScanData:
    """What a payload says. Bytes behind the last known value are let pass: newer firmware may add some.

    Raises:
        ColaError: the payload is no telegram, or too short for its command.
    """
    name, arguments = split_command(payload)
    reader = open_reader(dialect, arguments)
    if name in ("sSN LMDscandata", "sRA LMDscandata"):
        return read_scan_data(reader)
    if name == "sRA STlms":
        return Command(name, _read_state(reader))
    layout = LAYOUTS.get(name, "")
    return Command(name, tuple(reader.text() if code == "s" else reader.take(code)[0] for code in layout))


def _read_state(reader: Reader) -> tuple[int, int]:
    """State, and 1 outside of the temperature range; what follows, a calendar and LEDs, is of no use.

    Manuals disagree on whether the two have 8 or 16 bits in CoLa B. No state needs the upper byte, and behind two
    numbers of 8 bits there follows a length, which is more than 1.
    """
    state, outside = reader.take("BB")
    if state == 0:
        (third,) = reader.take("H")
        if third <= 1:
            return outside, third
    return state, outside
