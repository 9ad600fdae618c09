"""A scanner tells who it is and how it is, on a connection of its own, and is not changed by that."""

import math
import socket
import time
from dataclasses import asdict

import numpy as np
import pytest

from rtlog_server.devices.device import DeviceError
from rtlog_server.devices.lms111.cola import Dialect
from rtlog_server.devices.lms111.connection import Connection, open_connection
from rtlog_server.devices.lms111.emulator import Lms111Emulator
from rtlog_server.devices.lms111.identity import ask_identity, identify


def measure(emulator: Lms111Emulator) -> None:
    """Let it have a scan, which it keeps only while somebody is registered."""
    with open_connection(*emulator.address) as connection:
        connection.ask("sEN LMDscandata", 1)
        emulator.send_scan(np.full(541, 3.0), time.monotonic_ns() - 50_000_000, math.radians(-135), math.radians(0.5))
        assert connection.receive(time.monotonic_ns() + 2_000_000_000) is not None


@pytest.mark.parametrize("dialect", ["A", "B"])
def test_all_that_a_scanner_tells(dialect: str) -> None:
    with Lms111Emulator(dialect=dialect, serial_no=14090017) as emulator:
        measure(emulator)
        identity = identify(*emulator.address)
    assert asdict(identity) == {
        "dialect": f"CoLa {dialect}",
        "model": "LMS111 emulator",
        "firmware": "V1.80.2",
        "serial_no": 14090017,
        "location": "not defined",
        "state": 7,
        "outside_temperature": False,
        "device_state": 1,
        "contamination": 0,
        "device_status": 0,
        "operating_hours": 111.0,
    }
    assert identity.problem == ""


def test_a_scanner_that_is_still_starting_has_no_serial_number_yet() -> None:
    with Lms111Emulator(start_s=60) as emulator:
        identity = identify(*emulator.address)
    assert identity.serial_no is None
    assert identity.problem == "is initialising, does not measure yet"


def test_an_error_of_the_device_is_told() -> None:
    with Lms111Emulator() as emulator:
        emulator.set_status(1)
        assert "the device reports an error" in identify(*emulator.address).problem
        measure(emulator)
        assert "the device reports an error" in identify(*emulator.address).problem


@pytest.mark.parametrize(("status", "problem"), [(2, "front window is dirty"), (4, "front window is too dirty")])
def test_a_dirty_window_is_told_also_by_a_firmware_that_knows_it_from_its_scans_alone(
    status: int, problem: str
) -> None:
    with Lms111Emulator() as emulator:
        emulator.set_status(status)
        measure(emulator)
        identity = identify(*emulator.address)
        assert identity.contamination == status // 2
        assert identity.problem == ""
        emulator.set_error("sRN LCMstate", 3)
        identity = identify(*emulator.address)
        assert identity.contamination is None
        assert identity.problem == f"{problem}: clean the window"


def test_outside_of_its_temperature_range() -> None:
    with Lms111Emulator() as emulator:
        emulator.set_temperature(outside=True)
        identity = identify(*emulator.address)
    assert identity.outside_temperature
    assert "temperature" in identity.problem


def test_asking_changes_nothing_and_leaves_no_login() -> None:
    with Lms111Emulator() as emulator, open_connection(*emulator.address) as connection:
        first = ask_identity(connection)
        with pytest.raises(DeviceError, match=r"variable is write-protected \(sFA 10\)"):
            connection.ask("sWN LMPoutputRange", 1, 5000, 0, 1800000)
        assert ask_identity(connection) == first


def test_nobody_there(free_port: int) -> None:
    with pytest.raises(DeviceError, match=f"LMS111 at 127.0.0.1:{free_port}: .*refused"):
        identify("127.0.0.1", free_port)


def test_somebody_there_who_says_nothing() -> None:
    with socket.create_server(("127.0.0.1", 0)) as deaf:
        port = deaf.getsockname()[1]
        with pytest.raises(DeviceError, match="answers neither in CoLa A nor in CoLa B"):
            identify("127.0.0.1", port)


def test_a_connection_in_the_wrong_dialect_meets_silence() -> None:
    with (
        Lms111Emulator(dialect="B") as emulator,
        Connection(*emulator.address, Dialect.A) as connection,
        pytest.raises(DeviceError, match="no answer to sRN STlms"),
    ):
        connection.ask("sRN STlms", limit_s=0.2)
