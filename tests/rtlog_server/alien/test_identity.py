"""What `read_identity` tells of a reader, whatever state it was left in."""

import contextlib
import time

from hw_profiles.profile import RfidDevice
from rtlog_server.devices.alien.console import Console
from rtlog_server.devices.alien.emulator import Alr9650Emulator
from rtlog_server.devices.alien.identity import ReaderIdentity, ask_setting, read_identity


def identify(emulator: Alr9650Emulator) -> ReaderIdentity:
    with contextlib.closing(Console(RfidDevice(host="127.0.0.1", port=emulator.port))) as console:
        assert ask_setting(console, "AcqG2AntennaCombine") == ""  # what it lacks
        return read_identity(console, time.time_ns())


def test_the_reader_says_who_it_is_and_what_time_it_has() -> None:
    with Alr9650Emulator() as emulator:
        identity = identify(emulator)
    assert identity.name == "Alien RFID Reader"
    assert identity.reader_type.startswith("Alien RFID Tag Reader, Model: ALR-9650")
    assert identity.firmware == "14.07.01.00"
    assert identity.mac_address.count(":") == 5
    assert (identity.max_antenna, identity.antenna_sequence) == ("1", "0")
    assert identity.rf_attenuation == "0"
    assert identity.clock.startswith("1970/01/01 00:00:0")
    assert identity.clock_error_s is not None
    assert identity.clock_error_s < -50 * 365 * 86400
