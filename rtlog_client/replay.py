"""Replay at the wire: a recording drives the device emulators, and an unmodified server samples them in real time.

    recording     standing still . . . |scan     scan   tag  scan         UTC of the recording
    this host   now ───── lead ────────┼─────────┼──────┼────┼─────       UTC of the recording + offset_ns

In: a recording, a profile with the addresses where the devices are to stand, a fault script. Out: emulators that
measure at the recorded times, and a `ReplayReport`. The law: the offset is fixed at the start. It puts recorded ticks
on whole multiples of the tick period in UTC, as a server's are, so that each sample comes in the tick in which it was
recorded. At a rate of r all goes r times as fast; a server with ticks of 1/r of the recorded period then sees the same.

Scans and tags come at their recorded stamps; the wheels turn evenly from one recorded reading to the next. Until the
start the vehicle stands still: its scanner sends the first scan again and again, as no scanner falls silent.
"""

import heapq
import logging
import math
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from itertools import chain, islice
from pathlib import Path
from typing import Any

from hw_profiles.errors import BadInputError, RTLogError
from hw_profiles.profile import Profile, parse_profile
from rtlog_client.drive_log import Event, Span, read_events, read_span
from rtlog_client.encoder_track import read_encoder_track
from rtlog_client.fault_player import FaultPlayer
from rtlog_client.faults import FaultScript, check_devices
from rtlog_client.log_file import read_info
from rtlog_client.replay_report import ReplayReport
from rtlog_client.stage import Stage, addressed_devices, addressed_lasers, ask_realtime
from rtlog_client.stalls import StallWatch
from rtlog_server.devices.lms111.emulator import Lms111Emulator
from rtlog_server.ticker import utc_offset_ns

log = logging.getLogger(__name__)

LEAD_S = 3.0  # a server that looks for its devices finds them within two
TAIL_S = 0.5  # after the end, so that the last samples are still collected
SHORTEST_NS, LONGEST_NS = 5_000_000, 100_000_000  # between two scans of a vehicle that stands still
STANDING = -1  # Event.order of a scan before the start
SCAN_AHEAD_NS = 20_000_000  # a scan is given to its emulator so long before the first ray
DEFAULT_PERIOD_S = 0.1  # of recordings that do not say
NO_FAULTS = FaultScript()


def serve_devices(
    recording: Path,
    profile: Profile,
    stopping: threading.Event,
    *,
    start_s: float = 0.0,
    duration_s: float | None = None,
    lead_s: float = LEAD_S,
    rate: float | None = 1.0,
    faults: FaultScript = NO_FAULTS,
) -> ReplayReport:
    """Be the devices of `profile` until the recording, or the part of it, is over or `stopping` is set.

    `rate` says how much faster than it was recorded; None: one recorded tick for each tick of the profile.

    Raises:
        BadInputError: the recording lacks what a device of the profile measures, the profile has no devices, or lacks
            one that a fault is for.
        RTLogError: an address is taken, or a scan is one that no such scanner can measure.
    """
    check_devices(faults, addressed_devices(profile), profile.name)
    span = read_span(recording, start_s, duration_s)
    rate = rate or recorded_period_s(recording) / profile.tick_period_s
    lasers = list(addressed_lasers(profile))
    standing = [_standing_still(recording, name, span, round(lead_s * rate * 1e9)) for name in lasers]
    track = read_encoder_track(recording, profile) if profile.encoder_bus is not None else None
    events = read_events(recording, [*lasers, *(["rfid"] if profile.rfid is not None else [])], span)

    ask_realtime()
    utc_ns = utc_offset_ns()
    report = _timeline(span, time.monotonic_ns() + utc_ns + round(lead_s * 1e9), profile.tick_period_s, rate)

    def angle(name: str, at_ns: int) -> float:
        assert track is not None  # there is an encoder bus
        return track.angle(name, report.recorded_ns(at_ns + utc_ns))

    with ExitStack() as stack:
        watch = stack.enter_context(StallWatch(utc_ns))
        stage = stack.enter_context(Stage(profile, angle, faults.devices, faults.seed))
        length_s = (span.end_ns - span.start_ns) * 1e-9
        log.info("standing still for %g s, then %.1f s of drive at %g times its speed", lead_s, length_s, rate)
        player = FaultPlayer(faults, stage.lines, report.host_ns(span.start_ns) - utc_ns, utc_ns)
        stack.callback(player.close)
        counts = _play(chain(heapq.merge(*standing), events), stage, report, utc_ns, stopping)
        stopping.wait(max(0.0, (report.host_ns(span.end_ns) - utc_ns - time.monotonic_ns()) * 1e-9) + TAIL_S)
    scans, unheard, reads = counts
    return replace(
        report, scans=scans, unheard_scans=unheard, tag_reads=reads, faults=player.played, stalls=watch.stalls
    )


def recorded_period_s(recording: Path) -> float:
    """From tick to tick of the recording."""
    text = read_info(recording).profile_toml
    return DEFAULT_PERIOD_S if text is None else parse_profile(text, f"in {recording}").tick_period_s


def _timeline(span: Span, earliest_ns: int, period_s: float, rate: float) -> ReplayReport:
    """Starts the span as soon as may be, at `earliest_ns` or later, with ticks on multiples of the period in UTC."""
    period_ns = round(period_s * 1e9)
    lag_ns = round((span.start_ns - span.first_tick_ns) / rate)  # of the start behind the recording's first tick
    start_ns = -(-(earliest_ns - lag_ns) // period_ns) * period_ns + lag_ns
    return ReplayReport(start_ns - span.start_ns, span.start_ns, span.end_ns, 0, 0, 0, rate)


def _standing_still(recording: Path, device: str, span: Span, lead_ns: int) -> list[Event]:
    """The first scan again and again for so long before it, as far apart as it and the next."""
    first_two = list(islice(read_events(recording, [device], span), 2))
    if not first_two:
        raise BadInputError(f"{recording}: no scan of {device} in the part to replay, and the profile has that laser")
    first, apart_ns = first_two[0], first_two[-1].stamp_ns - first_two[0].stamp_ns
    apart_ns = apart_ns if SHORTEST_NS <= apart_ns <= LONGEST_NS else LONGEST_NS
    count = math.ceil(lead_ns / apart_ns)
    return [Event(first.stamp_ns - k * apart_ns, STANDING, device, first.content) for k in range(count, 0, -1)]


def _play(
    events: Iterator[Event], stage: Stage, report: ReplayReport, utc_ns: int, stopping: threading.Event
) -> tuple[int, int, int]:
    """Give each event to its emulator when its time has come. Returns: scans, unheard scans, tag reads."""
    scans = unheard = reads = 0
    for event in events:
        at_ns = report.host_ns(event.stamp_ns) - utc_ns
        laser = stage.lasers.get(event.device)
        ahead_ns = 0 if laser is None else SCAN_AHEAD_NS
        if stopping.wait(max(0.0, (at_ns - ahead_ns - time.monotonic_ns()) * 1e-9)):
            break
        if laser is not None:
            _send_scan(laser, event.content, at_ns)
            scans += event.order != STANDING
            unheard += event.order != STANDING and not laser.wait_streaming(0.0)
        elif stage.reader is not None:
            read = event.content
            stage.reader.read_tag(read.epc, read.antenna, read.rssi, max(1, read.count))
            reads += 1
    return scans, unheard, reads


def _send_scan(laser: Lms111Emulator, scan: Any, first_ray_ns: int) -> None:
    """Raises: RTLogError: the scan is none that an LMS111 can measure."""
    ranges, intensities, start, step = scan.ranges, scan.intensities, scan.angle_min, scan.angle_increment
    if step < 0:  # of a scanner that hangs upside down; ours turns one way only
        ranges, intensities = ranges[::-1], intensities[::-1]
        start, step = start + (len(ranges) - 1) * step, -step
    try:
        laser.send_scan(ranges, first_ray_ns, start, step, intensities)
    except ValueError as error:
        raise RTLogError(f"a scan that no LMS111 can measure: {error}") from error
