"""Is every device there and well? Each is opened as the server would, for some seconds, then asked who and how it is.

In: a profile. Out: `Finding`s of each device, in the order of the profile; what a device tells of itself is its
folder's business (devices/*/check.py). The law: a server at work is left alone, for it holds the devices.
"""

import errno
import socket
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

from hw_profiles.errors import RTLogError
from hw_profiles.profile import CanBus, Laser, Profile, RfidDevice, SeiBus
from rtlog_server.devices import open_devices
from rtlog_server.devices.alien.check import check_reader
from rtlog_server.devices.device import Device, DeviceError, TickGrid
from rtlog_server.devices.lms111.check import check_scanner
from rtlog_server.devices.sei.check import check_bus
from rtlog_server.finding import Finding

# To connect: an encoder bus left at the wrong speed takes a second attempt, a scanner starts its motor.
TIME_LIMIT_S = 5.0
WATCH_S = 2.0  # over which rates are measured, or three ticks
RATE_TOLERANCE = 0.2
POLL_S = 0.02
ENCODERS_UNWELL = "see the rows of the encoders"


@dataclass(frozen=True, slots=True)
class Place:
    """A device as the profile has it."""

    ask: Callable[[Device[Any]], list[Finding]]  # who it is and how; raises DeviceError if it is not there
    rate_hz: float | None  # of its samples; None: they come when there is something to tell
    advice: str  # what to look at when it does not answer
    unwell: str  # and when it answers, but its driver has something to say


def check_devices(
    profile: Profile, time_limit_s: float = TIME_LIMIT_S, watch_s: float = WATCH_S
) -> dict[str, list[Finding]]:
    """Try every device of the profile; what was found, by device.

    Args:
        profile: of the vehicle.
        time_limit_s: to connect.
        watch_s: how long rates are measured; three ticks at the least.

    Raises:
        BadInputError: the profile lacks a device section.
        RTLogError: the server is running.
    """
    devices, places = open_devices(profile), _places(profile)
    _leave_server_alone(profile)
    grid = TickGrid(time.monotonic_ns(), round(profile.tick_period_s * 1e9))
    watch_s = max(watch_s, 3 * profile.tick_period_s)
    for device in devices:
        device.start(grid)
    with ThreadPoolExecutor(len(devices) or 1) as pool:
        findings = pool.map(lambda device: _check(device, places[device.name], time_limit_s, watch_s), devices)
        return {device.name: found for device, found in zip(devices, findings, strict=True)}


def _leave_server_alone(profile: Profile) -> None:
    for endpoint in profile.zenoh.listen:
        protocol, _, address = endpoint.partition("/")
        host, _, port = address.rpartition(":")
        if protocol != "tcp" or not port.isdigit():
            continue
        try:
            socket.create_server((host, int(port))).close()
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                reason = f"{endpoint} is taken: the server is running and holds the devices"
                raise RTLogError(f"{reason}; systemctl stop rtlog-server, then check") from error


def _check(device: Device[Any], place: Place, time_limit_s: float, watch_s: float) -> list[Finding]:
    watched = _watch(device, place, time_limit_s, watch_s)
    device.close()
    try:
        return [*place.ask(device), *watched]  # only now: a scanner tells its serial number when it measures
    except (DeviceError, OSError) as error:
        reason = str(error) if device.connects else device.message  # the driver tried more often
        return [Finding("reachable", reason, False, place.advice)]


def _watch(device: Device[Any], place: Place, time_limit_s: float, watch_s: float) -> list[Finding]:
    """How it delivers."""
    deadline = time.monotonic() + time_limit_s
    while not device.connected:
        if time.monotonic() > deadline:
            return [Finding("driver", device.message, False, place.advice)]
        time.sleep(POLL_S)
    stamps_ns: list[int] = []
    age_s = float("inf")
    deadline = time.monotonic() + watch_s
    while device.connected and time.monotonic() < deadline:
        time.sleep(POLL_S)
        collected = device.collect(time.monotonic_ns())
        stamps_ns += [sample.measured_ns for sample in collected.samples]
        age_s = collected.age_s
    well = device.connected and device.message == "connected"
    findings = [Finding("driver", device.message, well, "" if well else place.unwell)]
    if place.rate_hz is not None:
        findings += _judge_stream(stamps_ns, age_s, place.rate_hz, watch_s)
    return findings


def _judge_stream(stamps_ns: list[int], age_s: float, wanted_hz: float, watch_s: float) -> list[Finding]:
    """Rate by the samples' own stamps, and whether these follow this board's clock."""
    if len(stamps_ns) < 2:
        return [Finding("rate", f"{len(stamps_ns)} samples in {watch_s:.0f} s", False, "the cable, and its load")]
    rate_hz = (len(stamps_ns) - 1) / ((stamps_ns[-1] - stamps_ns[0]) * 1e-9)
    well = abs(rate_hz - wanted_hz) <= RATE_TOLERANCE * wanted_hz
    advice = "" if well else "samples are lost or late: the cable, the network's load, other clients of the device"
    rate = Finding("rate", f"{rate_hz:.1f} Hz, wanted {wanted_hz:.1f}", well, advice)
    fresh = age_s < 3 / wanted_hz + 0.2
    advice = "" if fresh else "its clock does not run as this board's does: switch it off and on"
    return [rate, Finding("clock", f"newest sample {age_s * 1e3:.0f} ms old by its stamp", fresh, advice)]


def _places(profile: Profile) -> dict[str, Place]:
    """By the names of `open_devices`, which has checked the profile to say where they are."""
    places = {}
    for name, laser in (("primary", profile.lasers.primary), ("auxiliary", profile.lasers.auxiliary)):
        if laser is not None and laser.device is not None:
            places[f"laser/{name}"] = _scanner(laser)
    if profile.encoder_bus is not None:
        places["encoders"] = _encoders(profile, profile.encoder_bus)
    if profile.rfid is not None and profile.rfid.device is not None:
        places["rfid"] = _reader(profile.rfid.device)
    return places


def _scanner(laser: Laser) -> Place:
    settings = laser.device
    assert settings is not None  # checked by the caller
    advice = f"power, cable; ping {settings.host}; CoLa port {settings.port} (2111 or 2112)"
    return Place(lambda _: check_scanner(settings), settings.scan_frequency_hz, advice, "see window and state")


def _encoders(profile: Profile, bus: SeiBus | CanBus) -> Place:
    rate_hz = 1 / profile.tick_period_s
    if isinstance(bus, SeiBus):
        advice = f"adapter, encoders' power, addresses; ls -l {bus.port}; group dialout"
        return Place(lambda _: check_bus(bus, profile.encoders), rate_hz, advice, ENCODERS_UNWELL)
    advice = "encoders' power, node ids, terminators, bit rate"
    if bus.interface == "socketcan":
        advice += f"; ip -details link show {bus.channel}"
    elif bus.interface == "slcan":
        advice += f"; ls -l {bus.channel}; group dialout"

    def ask_driver(device: Device[Any]) -> list[Finding]:
        from rtlog_server.devices.cia406.check import judge_bus  # here, as in open_devices

        return judge_bus(bus, profile.encoders, device)

    return Place(ask_driver, rate_hz, advice, ENCODERS_UNWELL)


def _reader(settings: RfidDevice) -> Place:
    advice = f"power, cable; ls -l {settings.serial_port}; group dialout"
    if not settings.serial_port:
        advice = f"power, cable; ping {settings.host}; telnet {settings.host} {settings.port}; user and password"
    unwell = "a firewall of this board, or stream_host and stream_port of the profile; its tags are read all the same"
    return Place(lambda _: check_reader(settings), None, advice, unwell)
