"""Replay of a captured byte stream: an emulated scanner takes the server's login, then the captured bytes go out as
they are, each piece when the device's own clock says.

In: the bytes that a device once sent, a profile that says where it is to stand. Out: the same bytes from a socket, and
a `ReplayReport` whose recording's clock starts at the first scan.
"""

import logging
import threading
import time
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

from msgspec.structs import replace as with_fields

from hw_profiles.errors import BadInputError
from hw_profiles.profile import Lasers, Profile
from rtlog_client.capture import read_capture
from rtlog_client.fault_player import FaultPlayer
from rtlog_client.faults import FaultScript, check_devices
from rtlog_client.replay_report import ReplayReport
from rtlog_client.stage import Stage, addressed_lasers, ask_realtime
from rtlog_client.stalls import StallWatch
from rtlog_server.ticker import utc_offset_ns

log = logging.getLogger(__name__)

WAIT_S = 30.0  # for a server to ask for scans
TAIL_S = 0.5


def serve_capture(
    path: Path, profile: Profile, device: str, stopping: threading.Event, *, rate: float | None, faults: FaultScript
) -> ReplayReport:
    """Be this one device of `profile`: when a server asks for scans, send the captured bytes.

    `rate` says how much faster than the device sent them; None: as fast as the socket takes them.

    Raises:
        BadInputError: no capture of an LMS111, or the profile has no such scanner.
        RTLogError: the address is taken.
    """
    lasers = addressed_lasers(profile)
    if device not in lasers:
        there = ", ".join(lasers) or "none"
        raise BadInputError(f"profile {profile.name} gives no scanner {device} an address; it has {there}")
    check_devices(faults, [device], profile.name)
    capture = read_capture(path)
    alone = _alone(profile, device)
    ask_realtime()
    utc_ns = utc_offset_ns()
    with ExitStack() as stack:
        watch = stack.enter_context(StallWatch(utc_ns))
        stage = stack.enter_context(Stage(alone, _no_encoders, faults.devices, faults.seed, capture.dialect.name))
        scanner = stage.lasers[device]
        log.info("%d scans in %s; waiting for a server", capture.scans, capture.dialect.value)
        deadline = time.monotonic() + WAIT_S
        while not scanner.wait_streaming(0.1) and time.monotonic() < deadline and not stopping.is_set():
            pass
        start_ns = time.monotonic_ns()
        player = FaultPlayer(faults, stage.lines, start_ns, utc_ns)
        stack.callback(player.close)
        sent = unheard = 0
        for piece in capture.pieces:
            due_ns = start_ns + (0 if rate is None else round(piece.elapsed_ns / rate))
            if stopping.wait(max(0.0, (due_ns - time.monotonic_ns()) * 1e-9)):
                break
            unheard += piece.scan is not None and not scanner.wait_streaming(0.0)
            scanner.send_raw(piece.data)
            sent += piece.scan is not None
        stopping.wait(TAIL_S)
    elapsed_ns = capture.pieces[-1].elapsed_ns
    report = ReplayReport(start_ns + utc_ns, 0, elapsed_ns, sent, unheard, 0, rate or 0.0, capture_of=device)
    return replace(report, faults=player.played, stalls=watch.stalls)


def _alone(profile: Profile, device: str) -> Profile:
    lasers = profile.lasers
    one = Lasers(primary=lasers.primary, auxiliary=None)
    if device == "laser/auxiliary":
        one = Lasers(primary=with_fields(lasers.primary, device=None), auxiliary=lasers.auxiliary)
    return with_fields(profile, lasers=one, encoder_bus=None, rfid=None)


def _no_encoders(_name: str, _at_ns: int) -> float:
    raise AssertionError("a scanner alone has no encoders")
