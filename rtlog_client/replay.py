"""Replay at the wire: a recording drives the device emulators, and an unmodified server samples them in real time.

    recording     standing still . . . |scan     scan   tag  scan         UTC of the recording
    this host   now ───── lead ────────┼─────────┼──────┼────┼─────       UTC of the recording + offset_ns

In: a recording, a profile with the addresses where the devices are to stand. Out: emulators that measure at the
recorded times, and a `ReplayReport`. The law: the offset is fixed at the start. It puts recorded ticks on whole
multiples of the tick period in UTC, as a server's are, so that each sample comes in the tick in which it was recorded.

Scans and tags come at their recorded stamps; the wheels turn evenly from one recorded reading to the next. Until the
start the vehicle stands still: its scanner sends the first scan again and again, as no scanner falls silent.
"""

import logging
import math
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

from hw_profiles.errors import BadInputError, RTLogError
from hw_profiles.profile import Encoder, LaserDevice, Profile, SeiBus
from rtlog_client.drive_log import Event, JointTrack, Span, read_events, read_joint_track, read_span
from rtlog_server.devices.alien.emulator import Alr9650Emulator
from rtlog_server.devices.encoders import counts_at
from rtlog_server.devices.lms111.emulator import Lms111Emulator
from rtlog_server.devices.sei.emulator import SeiBusEmulator
from rtlog_server.ticker import utc_offset_ns
from rtlog_server.topics import AUXILIARY_SCAN, PRIMARY_SCAN, TAGS

log = logging.getLogger(__name__)

LEAD_S = 3.0  # a server that looks for its devices finds them within two
TAIL_S = 0.5  # after the end, so that the last samples are still collected
STANDING = -1  # Event.order of a scan before the start
SCAN_AHEAD_NS = 20_000_000  # a scan is given to its emulator so long before the first ray


@dataclass(frozen=True, slots=True)
class ReplayReport:
    """`offset_ns`, added to times of the recording or of its truth, gives UTC of this host."""

    offset_ns: int
    start_ns: int  # in the recording
    end_ns: int
    scans: int
    unheard_scans: int  # of these, sent while no server listened
    tag_reads: int


@dataclass(frozen=True, slots=True)
class Stage:
    """The emulators."""

    lasers: dict[str, Lms111Emulator]  # by topic
    reader: Alr9650Emulator | None


def serve_devices(
    recording: Path,
    profile: Profile,
    stopping: threading.Event,
    *,
    start_s: float = 0.0,
    duration_s: float | None = None,
    lead_s: float = LEAD_S,
) -> ReplayReport:
    """Be the devices of `profile` until the recording, or the part of it, is over or `stopping` is set.

    Raises:
        BadInputError: the recording lacks what a device of the profile measures, or the profile has no devices.
        RTLogError: an address is taken, or a scan is one that no such scanner can measure.
    """
    span = read_span(recording, start_s, duration_s)
    lasers = _laser_addresses(profile)
    first_scans = [_first_scan(recording, topic, span) for topic in lasers]
    names = [encoder.name for encoder in profile.encoders]
    track = read_joint_track(recording, names) if profile.encoder_bus is not None else None
    topics = [*lasers, *([TAGS.name] if profile.rfid is not None else [])]
    events = read_events(recording, topics, span)

    period_ns = round(profile.tick_period_s * 1e9)
    utc_ns = utc_offset_ns()
    offset_ns = _aligned_offset(span, time.monotonic_ns() + utc_ns + round(lead_s * 1e9), period_ns)
    clock_ns = offset_ns - utc_ns  # monotonic clock minus time of the recording
    with ExitStack() as stack:
        stage = _open_stage(profile, track, clock_ns, stack)
        log.info("standing still for %g s, then %.1f s of drive", lead_s, (span.end_ns - span.start_ns) * 1e-9)
        standing = _standing_still(first_scans, math.ceil(lead_s * 1e9 / period_ns), period_ns)
        counts = _play(chain(standing, events), stage, clock_ns, stopping)
        stopping.wait(max(0.0, (span.end_ns + clock_ns - time.monotonic_ns()) * 1e-9) + TAIL_S)
    return ReplayReport(offset_ns, span.start_ns, span.end_ns, *counts)


def _aligned_offset(span: Span, earliest_ns: int, period_ns: int) -> int:
    """The least offset that starts the span at `earliest_ns` or later and puts ticks on multiples of the period."""
    phase_ns = span.first_tick_ns % period_ns
    return -(-(earliest_ns - span.start_ns + phase_ns) // period_ns) * period_ns - phase_ns


def _laser_addresses(profile: Profile) -> dict[str, LaserDevice]:
    """By topic."""
    lasers = ((PRIMARY_SCAN, profile.lasers.primary), (AUXILIARY_SCAN, profile.lasers.auxiliary))
    return {topic.name: laser.device for topic, laser in lasers if laser is not None and laser.device is not None}


def _first_scan(recording: Path, topic: str, span: Span) -> Event:
    scan = next(read_events(recording, [topic], span), None)
    if scan is None:
        raise BadInputError(f"{recording}: no {topic} in the part to replay, and the profile has that laser")
    return scan


def _open_stage(profile: Profile, track: JointTrack | None, clock_ns: int, stack: ExitStack) -> Stage:
    """An emulator for every device that has an address."""
    lasers = {}
    reader = None
    where = ""
    try:
        for topic, laser in _laser_addresses(profile).items():
            where = f"{laser.host}:{laser.port}"
            lasers[topic] = stack.enter_context(Lms111Emulator(laser.host, laser.port))
        if profile.encoder_bus is not None and track is not None:
            where = profile.encoder_bus.port
            stack.enter_context(_encoder_bus(profile.encoder_bus, profile.encoders, track, clock_ns))
        if profile.rfid is not None and profile.rfid.device is not None:
            device = profile.rfid.device
            where = f"{device.host}:{device.port}"
            reader = stack.enter_context(Alr9650Emulator(device.host, device.port, device.username, device.password))
    except OSError as error:
        hint = "the profile must name addresses of this machine that are free"
        raise RTLogError(f"{where}: {error.strerror or error}; {hint}") from error
    if not where:
        raise BadInputError(f"profile {profile.name} gives no device an address: there is nothing to emulate")
    return Stage(lasers, reader)


def _encoder_bus(bus: SeiBus, fitted: list[Encoder], track: JointTrack, clock_ns: int) -> SeiBusEmulator:
    encoders = {encoder.address: encoder for encoder in fitted if encoder.address is not None}

    def position(address: int, at_ns: int) -> int:
        encoder = encoders[address]
        return total_counts(encoder, track.angle(encoder.name, at_ns - clock_ns))

    counts_per_turn = {address: encoder.counts_per_turn for address, encoder in encoders.items()}
    return SeiBusEmulator(Path(bus.port), counts_per_turn, position, bus.echo == "yes", bus.turns == "multi")


def total_counts(encoder: Encoder, angle_rad: float) -> int:
    """What the encoder counts at this angle: a wheel over many turns, steering within its turn."""
    if encoder.role == "steering":
        return counts_at(encoder, angle_rad)
    return round((-angle_rad if encoder.reversed else angle_rad) / math.tau * encoder.counts_per_turn)


def _standing_still(first_scans: list[Event], ticks: int, period_ns: int) -> Iterator[Event]:
    """The first scan of each laser, once for each tick before it."""
    for ahead in range(ticks, 0, -1):
        for scan in sorted(first_scans):
            yield Event(scan.stamp_ns - ahead * period_ns, STANDING, scan.topic, scan.content)


def _play(events: Iterator[Event], stage: Stage, clock_ns: int, stopping: threading.Event) -> tuple[int, int, int]:
    """Give each event to its emulator when its time has come. Returns: scans, unheard scans, tag reads."""
    scans = unheard = reads = 0
    for event in events:
        at_ns = event.stamp_ns + clock_ns
        laser = stage.lasers.get(event.topic)
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
