"""Who the reader is and how it stands, asked over its open console.

In: a `Console`, just logged in. Out: a `ReaderIdentity`; what the reader does not know or tell is "".

    with contextlib.closing(Console(device)) as console:
        identity = read_identity(console, time.time_ns())

It asks and sets nothing, so it may come before the driver's own settings.
"""

from dataclasses import dataclass

from rtlog_server.devices.alien import protocol
from rtlog_server.devices.alien.console import Console
from rtlog_server.devices.alien.protocol import AlienError
from rtlog_server.devices.alien.tag_line import parse_date_ms

MAX_TEXT = 120  # of what a reader may say of itself


@dataclass(frozen=True, slots=True)
class ReaderIdentity:
    """All texts as the reader gives them."""

    name: str
    reader_type: str  # with the model and its band
    mac_address: str  # unique; that of the network interface
    firmware: str
    max_antenna: str  # the highest index of an antenna port
    antenna_sequence: str  # the ports that are read in turn
    rf_attenuation: str  # in 0.1 dB below full power
    clock: str  # YYYY/MM/DD hh:mm:ss; a reader without a time server starts in 1970
    clock_error_s: float | None  # reader minus host, if its clock is read as UTC; None: it tells no time


def read_identity(console: Console, utc_ns: int) -> ReaderIdentity:
    """Ask the reader; `utc_ns` is the host's time now. Raises: DeviceError, the console is lost."""
    clock = ask_setting(console, "Time")
    return ReaderIdentity(
        name=ask_setting(console, "ReaderName"),
        reader_type=ask_setting(console, "ReaderType"),
        mac_address=ask_setting(console, "MACAddress"),
        firmware=ask_setting(console, "ReaderVersion"),
        max_antenna=ask_setting(console, "MaxAntenna"),
        antenna_sequence=ask_setting(console, "AntennaSequence"),
        rf_attenuation=ask_setting(console, "RFAttenuation"),
        clock=clock,
        clock_error_s=_clock_error_s(clock, utc_ns),
    )


def ask_setting(console: Console, name: str) -> str:
    """The value of a setting in one line, "" if the reader has none of that name. Raises: DeviceError."""
    try:
        value = protocol.parse_setting(console.ask(f"get {name}"))[1]
    except AlienError:
        return ""
    return " ".join(value.split())[:MAX_TEXT]


def _clock_error_s(clock: str, utc_ns: int) -> float | None:
    try:
        return round(parse_date_ms(clock) * 1e-3 - utc_ns * 1e-9, 3)
    except AlienError:
        return None
