"""Is the scanner well? In: its address. Out: rows for the table of `rtlog-server check`; nothing in it is changed."""

from hw_profiles.profile import LaserDevice
from rtlog_server.devices.lms111.identity import ScannerIdentity, identify
from rtlog_server.devices.lms111.protocol import CONTAMINATION
from rtlog_server.finding import Finding


def check_scanner(settings: LaserDevice) -> list[Finding]:
    """Ask the scanner who it is and how it is. Raises: DeviceError: it is not there, or does not answer."""
    identity = identify(settings.host, settings.port)
    findings = [
        Finding("reachable", f"{settings.host}:{settings.port}, {identity.dialect}"),
        Finding("identity", _describe(identity)),
        _window(identity),
    ]
    if identity.problem:
        problem, _, advice = identity.problem.partition(": ")
        findings.append(Finding("state", problem, False, advice or "wait for its motor and heater, then check again"))
    return findings


def _describe(identity: ScannerIdentity) -> str:
    told = [
        identity.model or "LMS1xx",
        f"serial number {identity.serial_no}" if identity.serial_no is not None else "serial number not told yet",
        f"firmware {identity.firmware}",
        f"at {identity.location!r}" if identity.location else "",
        f"{identity.operating_hours:.0f} h in operation" if identity.operating_hours is not None else "",
    ]
    return ", ".join(text for text in told if text)


def _window(identity: ScannerIdentity) -> Finding:
    if identity.contamination is None:
        return Finding("window", "this firmware does not tell")
    if identity.contamination == 0:
        return Finding("window", "clean")
    dirty = CONTAMINATION.get(identity.contamination, f"contamination {identity.contamination}")
    return Finding("window", dirty, False, "clean the front window with a soft, damp cloth")
