"""Which scanner is this, and how is it? What a person wants to know before a drive.

In: an open connection, or the address of a scanner. Out: `ScannerIdentity`. The law: it only asks; nothing in the
device is changed, nobody logs in. A question that the firmware refuses, ignores or answers in a way of its own stays
open (None), as old ones know few.
"""

from dataclasses import dataclass
from typing import Any

from rtlog_server.devices.lms111.connection import Connection, NoAnswerError, RefusedError, open_connection
from rtlog_server.devices.lms111.protocol import DEVICE_ERROR, MEASURING, state_name
from rtlog_server.devices.lms111.sweep import STATUS


@dataclass(frozen=True, slots=True)
class ScannerIdentity:
    dialect: str  # CoLa A or CoLa B
    model: str | None
    firmware: str
    serial_no: int | None  # told by its scans, so only while it measures
    location: str | None  # the name that somebody gave it
    state: int  # of `protocol.STATES`: 7 measures
    outside_temperature: bool  # it is too cold or too hot for it
    device_state: int | None  # 0: busy or somebody is logged in, 1: ready, 2: error
    contamination: int | None  # of `protocol.CONTAMINATION`: 0 is a clean window
    device_status: int | None  # of its newest scan, of `sweep.STATUS`: 0 is well
    operating_hours: float | None

    @property
    def problem(self) -> str:
        """What keeps it from measuring well, in one line; empty: nothing, but for a dirt that `contamination` tells."""
        if self.device_state == DEVICE_ERROR or self.device_status == 1:
            return "the device reports an error: switch it off and on; if it stays, it needs service"
        if self.device_status and not self.contamination:
            return f"{STATUS.get(self.device_status, f'device status {self.device_status}')}: clean the window"
        if self.outside_temperature:
            return "outside of its temperature range: wait for the heater, or cool it"
        if self.state != MEASURING:
            return f"is {state_name(self.state)}, does not measure yet"
        return ""


def identify(host: str, port: int) -> ScannerIdentity:
    """Ask the scanner at an address, on a connection of its own.

    Raises:
        DeviceError: nobody is there, it does not answer, or it refuses what every LMS111 answers.
    """
    with open_connection(host, port) as connection:
        return ask_identity(connection)


def ask_identity(connection: Connection) -> ScannerIdentity:
    """Ask on an open connection that streams no scans. Raises: DeviceError."""
    (firmware,) = connection.ask("sRN FirmwareVersion")
    state, outside_temperature = connection.ask("sRN STlms")
    (scan,) = _ask_if_known(connection, "sRN LMDscandata") if state == MEASURING else (None,)
    model, _ = _ask_if_known(connection, "sRN DeviceIdent", 2)
    (location,) = _ask_if_known(connection, "sRN LocationName")
    (device_state,) = _ask_if_known(connection, "sRN SCdevicestate")
    (contamination,) = _ask_if_known(connection, "sRN LCMstate")
    (tenths_of_hours,) = _ask_if_known(connection, "sRN ODoprh")
    return ScannerIdentity(
        dialect=connection.dialect.value,
        model=model.strip() if model is not None else None,
        firmware=firmware.strip(),
        serial_no=scan.serial_no if scan else None,
        location=location.strip() if location is not None else None,
        state=state,
        outside_temperature=bool(outside_temperature),
        device_state=device_state,
        contamination=contamination,
        device_status=scan.device_status[1] if scan else None,
        operating_hours=tenths_of_hours / 10 if tenths_of_hours is not None else None,
    )


def _ask_if_known(connection: Connection, command: str, values: int = 1) -> tuple[Any, ...]:
    """The values of the reply; so many times None if the device does not know the command, or has nothing to say."""
    try:
        return connection.ask(command)
    except RefusedError:
        return (None,) * values
    except NoAnswerError:
        connection.ask("sRN STlms")  # every scanner answers that: one that is gone is not taken for an old one
        return (None,) * values
