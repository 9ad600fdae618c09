"""Are the encoders on the CAN bus well? In: what their driver knows after a few rounds. Out: rows for the table of
`rtlog-server check`. A bus has no second place from which to ask: the driver itself asks each node who it is.
"""

from collections.abc import Sequence

from hw_profiles.profile import CanBus, Encoder
from rtlog_server.devices.device import Device, DeviceError
from rtlog_server.devices.encoders import EncoderReading
from rtlog_server.finding import Finding


def judge_bus(bus: CanBus, encoders: Sequence[Encoder], driver: Device[EncoderReading]) -> list[Finding]:
    """Rows from what the driver has in `identity` and `diagnostics`. Raises: DeviceError: it never came to run."""
    if not driver.connects:
        raise DeviceError(driver.message)
    identity, diagnostics = driver.identity, driver.diagnostics
    findings = [_judge_controller(bus, diagnostics.get("controller", "not told"))]
    for encoder in encoders:
        subject, state = f"identity of {encoder.name}", diagnostics.get(encoder.name, "silent")
        found = identity.get(encoder.name, f"node {encoder.address} has not told")
        if state == "ok":
            findings.append(Finding(subject, found))
        else:
            advice = f"its power and cable; is its node id {encoder.address}, its bit rate {bus.bitrate}?"
            findings.append(Finding(subject, f"{found}: {state}", False, advice))
    return findings


def _judge_controller(bus: CanBus, state: str) -> Finding:
    if state == "ok":
        return Finding("bus", "the controller has reported no errors")
    look = f"; ip -details -statistics link show {bus.channel}" if bus.interface == "socketcan" else ""
    return Finding("bus", state, False, f"cable, terminators at both ends, the same bit rate everywhere{look}")
