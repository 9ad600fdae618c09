"""Is every device there? Each is opened as the server would, all at once, for a few seconds."""

import time
from dataclasses import dataclass
from typing import Any

from hw_profiles.profile import CanBus, Profile, SeiBus
from rtlog_server.devices import open_devices
from rtlog_server.devices.device import Device, TickGrid

TIME_LIMIT_S = 3.0  # an encoder bus left at the wrong speed takes a second attempt
FIRST_SAMPLES_S = 1.0
POLL_S = 0.02


@dataclass(frozen=True, slots=True)
class CheckResult:
    device: str
    address: str
    reachable: bool
    identity: dict[str, str]
    message: str  # "connected", or what is wrong
    advice: str  # what to do next; empty if nothing


def check_devices(profile: Profile, time_limit_s: float = TIME_LIMIT_S) -> list[CheckResult]:
    """Try every device of the profile. Raises: BadInputError: the profile lacks a device section."""
    devices = open_devices(profile)
    grid = TickGrid(time.monotonic_ns(), round(profile.tick_period_s * 1e9))
    for device in devices:
        device.start(grid)
    deadline = time.monotonic() + time_limit_s
    results = [_result(profile, device, _wait_for(device, deadline)) for device in devices]
    for device in devices:
        device.close(timeout_s=0.0)
    for device in devices:
        device.close()
    return results


def _wait_for(device: Device[Any], deadline: float) -> str:
    """Wait until the device delivers; what is wrong with it, or "" if it is well."""
    while not device.connected:
        if time.monotonic() > deadline:
            return device.message
        time.sleep(POLL_S)
    deadline = time.monotonic() + FIRST_SAMPLES_S
    samples = 0
    while samples < 2 and device.connected and time.monotonic() < deadline:  # at the second, the first is judged
        time.sleep(POLL_S)
        samples += len(device.collect(time.monotonic_ns()).samples)
    if device.connected and not samples and device.name != "rfid":  # without a tag nearby a reader has nothing to tell
        return f"connected, but no data came within {FIRST_SAMPLES_S:.0f} s"
    return "" if device.message == "connected" else device.message


def _result(profile: Profile, device: Device[Any], problem: str) -> CheckResult:
    address, advice = _whereabouts(profile)[device.name]
    message, advice = (problem, advice) if problem else ("connected", "")
    return CheckResult(device.name, address, not problem, dict(device.identity), message, advice)


def _whereabouts(profile: Profile) -> dict[str, tuple[str, str]]:
    """For each device: its address, and what to look at when it does not answer there."""
    places = {}
    for name, laser in (("primary", profile.lasers.primary), ("auxiliary", profile.lasers.auxiliary)):
        if laser is not None and laser.device is not None:
            host, port = laser.device.host, laser.device.port
            places[f"laser/{name}"] = (f"{host}:{port}", f"power, cable; ping {host}; CoLa port {port} (2111 or 2112)")
    if profile.encoder_bus is not None:
        places["encoders"] = (profile.encoder_bus.place, _encoder_advice(profile.encoder_bus))
    if profile.rfid is not None and profile.rfid.device is not None:
        host, port = profile.rfid.device.host, profile.rfid.device.port
        places["rfid"] = (f"{host}:{port}", f"power, cable; ping {host}; telnet {host} {port}; user and password")
    return places


def _encoder_advice(bus: SeiBus | CanBus) -> str:
    if isinstance(bus, SeiBus):
        return f"adapter, encoders' power, addresses; ls -l {bus.port}; group dialout"
    wiring = "encoders' power, node ids, terminators, bit rate"
    if bus.interface == "socketcan":
        return f"{wiring}; ip -details link show {bus.channel}"
    return f"{wiring}; ls -l {bus.channel}; group dialout" if bus.interface == "slcan" else wiring
