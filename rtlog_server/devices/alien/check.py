"""Is the reader well? In: where its console is. Out: rows for the table of `rtlog-server check`; nothing is set."""

import contextlib
import time

from hw_profiles.profile import RfidDevice
from rtlog_server.devices.alien.console import Console
from rtlog_server.devices.alien.identity import ReaderIdentity, read_identity
from rtlog_server.finding import Finding

CLOCK_S = 3600.0  # a reader whose clock is off by more was never set


def check_reader(settings: RfidDevice) -> list[Finding]:
    """Ask the reader who it is and how it is. Raises: DeviceError: it is not there, refuses us, or does not answer."""
    with contextlib.closing(Console(settings)) as console:
        identity = read_identity(console, time.time_ns())
    told = (identity.reader_type, identity.name, f"firmware {identity.firmware}", f"MAC {identity.mac_address}")
    return [
        Finding("reachable", settings.place),
        Finding("identity", ", ".join(text for text in told if text)),
        _antenna(identity),
        _clock(identity),
    ]


def _antenna(identity: ReaderIdentity) -> Finding:
    if not identity.antenna_sequence:
        return Finding("antenna", "the reader does not tell which it reads")
    found = f"reads {identity.antenna_sequence} of 0 … {identity.max_antenna or '?'}"
    if identity.rf_attenuation not in ("", "0"):
        found += f", {identity.rf_attenuation} tenths of a dB below full power"
    ports = identity.antenna_sequence.replace(",", " ").split()
    highest = identity.max_antenna
    if highest.isdigit() and any(port.isdigit() and int(port) > int(highest) for port in ports):
        return Finding("antenna", found, False, "set AntennaSequence at the reader's console to ports that it has")
    return Finding("antenna", found)


def _clock(identity: ReaderIdentity) -> Finding:
    """Its clock may be wrong: reads are stamped by the host then."""
    if identity.clock_error_s is None or abs(identity.clock_error_s) > CLOCK_S:
        return Finding("clock", f"{identity.clock or 'not told'}: not set; reads are stamped by this board")
    return Finding("clock", f"{identity.clock_error_s:+.1f} s from this board's")
