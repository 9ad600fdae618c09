"""The devices of a vehicle: a new kind is a new folder here and a line in `open_devices`."""

from typing import Any

from hw_profiles.errors import BadInputError
from hw_profiles.profile import CanBus, Encoder, Profile, SeiBus
from rtlog_server.devices.alien.driver import Alr9650
from rtlog_server.devices.device import Device
from rtlog_server.devices.encoders import EncoderReading
from rtlog_server.devices.lms111.driver import Lms111
from rtlog_server.devices.sei.driver import SeiEncoders


def open_devices(profile: Profile) -> list[Device[Any]]:
    """A driver for each device of the profile, not started yet; names are the stems of their topics.

    Raises:
        BadInputError: the profile says what a device is, but not where it is reached.
    """
    devices: list[Device[Any]] = []
    for name, laser in (("primary", profile.lasers.primary), ("auxiliary", profile.lasers.auxiliary)):
        if laser is not None:
            if laser.device is None:
                raise _lacks(profile, f"[lasers.{name}.device] with the scanner's host")
            devices.append(Lms111(f"laser/{name}", laser.device))
    if profile.encoders:
        if profile.encoder_bus is None:
            raise _lacks(profile, "[encoder_bus] with the bus's port or channel")
        devices.append(_open_encoders(profile.encoder_bus, profile.encoders))
    if profile.rfid is not None:
        if profile.rfid.device is None:
            raise _lacks(profile, "[rfid.device] with the reader's host or serial port")
        devices.append(Alr9650("rfid", profile.rfid.device))
    return devices


def _open_encoders(bus: SeiBus | CanBus, encoders: list[Encoder]) -> Device[EncoderReading]:
    if isinstance(bus, SeiBus):
        return SeiEncoders("encoders", bus, encoders)
    from rtlog_server.devices.cia406.driver import Cia406Encoders  # here: python-can and canopen take 0.15 s to load

    return Cia406Encoders("encoders", bus, encoders)


def _lacks(profile: Profile, section: str) -> BadInputError:
    return BadInputError(f"profile {profile.name}: to run the devices it needs {section}")
