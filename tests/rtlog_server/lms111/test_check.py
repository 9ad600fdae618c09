"""What `check` tells of a scanner that is not well."""

from hw_profiles.profile import LaserDevice
from rtlog_server.devices.lms111.check import check_scanner
from rtlog_server.devices.lms111.emulator import Lms111Emulator


def test_a_dirty_window_hides_nothing_else() -> None:
    with Lms111Emulator(start_s=60) as emulator:
        emulator.set_status(4)
        findings = check_scanner(LaserDevice(host=emulator.address[0], port=emulator.address[1]))
    assert {finding.subject: finding.found for finding in findings if not finding.well} == {
        "window": "front window is too dirty",
        "state": "is initialising, does not measure yet",
    }
