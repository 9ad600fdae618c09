"""One simulated drive as a recording and its truth, as if our server had sampled it and our client recorded it.

In: a run's truth and its sensors' arrays. Out: `<run id>.mcap` and `<run id>.tum`. Times inside are seconds since the
run's first tick; stamps are nanoseconds UTC.
"""

import uuid
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from itertools import groupby
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hw_profiles.profile import Profile
from processing.simulation import sensors
from processing.simulation.drive import Drive
from processing.simulation.hazard_traffic import Obstacle
from processing.simulation.raycast import SegmentGrid
from processing.simulation.world import Noise, Scanner, Tag
from rtlog_client.log_file import LogWriter
from rtlog_server import messages, topics

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]
LATENESS_NS = (20_000, 200_000)  # of a tick, on an idle board
STALE_S = 0.35  # a sensor that was silent for longer is told as such


@dataclass(frozen=True, slots=True)
class Samples:
    """What was sampled, one row a tick; times in seconds since the first tick, as they are stamped."""

    scanner: Scanner
    tick_s: Array  # (n,)
    sweep_s: Array  # (n,) first ray
    ranges: NDArray[np.float32]  # (n, beams) metres
    latched_s: Array  # (n,) encoders
    positions: Array  # (n, encoders) radians
    round_s: Array  # (n,) last inventory round
    readings: list[sensors.TagReading]
    has_scan: NDArray[np.bool_]  # (n,)
    has_joints: NDArray[np.bool_]  # (n,)
    is_recorded: NDArray[np.bool_]  # (n,)


def sample_drive(
    drive: Drive,
    grid: SegmentGrid,
    profile: Profile,
    tags: list[Tag],
    places: Array,
    scanner: Scanner,
    noise: Noise,
    generators: dict[str, np.random.Generator],
    obstacles: Sequence[Obstacle] = (),
    scans_late_s: float = 0.0,
    odometry_late_s: float = 0.0,
) -> Samples:
    """Drive past walls, obstacles, tags (at `places`, (m, 2)), sampling every tick; what comes late is stamped late."""
    clock = generators["clock"]
    tick_s = np.asarray(
        np.arange(int(drive.duration_s / profile.tick_period_s) + 1) * profile.tick_period_s, dtype=float
    )
    sweep_s = sensors.sweep_times(tick_s, clock.uniform(0.0, sensors.SWEEP_PERIOD_S), scanner)
    latched_s = tick_s - sensors.ENCODER_LATENCY_S + clock.uniform(-1e-3, 1e-3, len(tick_s))
    mount = profile.lasers.primary.mount
    seen_s, counted_s = sweep_s - scans_late_s, latched_s - odometry_late_s
    ranges = sensors.simulate_sweeps(drive, grid, scanner, mount, seen_s, noise.range_m, generators["laser"], obstacles)
    positions = sensors.simulate_encoders(drive, profile, counted_s, noise, generators["encoders"])
    phase_s = clock.uniform(-sensors.ROUND_PERIOD_S, 0.0) - profile.tick_period_s
    missed = noise.missed_pass_probability
    round_s, readings = sensors.simulate_reads(drive, tags, places, tick_s, phase_s, missed, generators["rfid"])
    lost = generators["losses"].random((2, len(tick_s)))
    has_scan, is_recorded = lost[0] >= noise.dropped_scan_probability, lost[1] >= noise.dropped_tick_probability
    has_joints = np.ones(len(tick_s), dtype=bool)
    return Samples(
        scanner, tick_s, sweep_s, ranges, latched_s, positions, round_s, readings, has_scan, has_joints, is_recorded
    )


def stamps_of(start_ns: int, time_s: Array) -> Stamps:
    return start_ns + np.round(np.asarray(time_s) * 1e9).astype(np.int64)


def write_recording(
    path: Path, samples: Samples, profile: Profile, profile_toml: str, start_ns: int, boot_id: uuid.UUID
) -> None:
    """The messages of every tick, in the order in which the server sends them."""
    metadata = {
        "vehicle": profile.name,
        "profile": profile.name,
        "boot_id": str(boot_id),
        "software": f"rtlog {version('rtlog')} simulation",
    }
    tick_ns, sweep_ns = stamps_of(start_ns, samples.tick_s), stamps_of(start_ns, samples.sweep_s)
    latched_ns, round_ns = stamps_of(start_ns, samples.latched_s), stamps_of(start_ns, samples.round_s)
    lateness_ns = np.random.default_rng(boot_id.int).integers(*LATENESS_NS, len(tick_ns))
    newest_sweep_ns = np.maximum.accumulate(np.where(samples.has_scan, sweep_ns, sweep_ns[0]))
    newest_latched_ns = np.maximum.accumulate(np.where(samples.has_joints, latched_ns, latched_ns[0]))
    reads = {tick: list(found) for tick, found in groupby(samples.readings, key=lambda reading: reading.tick)}
    names = [encoder.name for encoder in profile.encoders]
    scan_number = np.cumsum(samples.has_scan) - 1  # the server numbers what it sent, recorded or not
    joint_number = np.cumsum(samples.has_joints) - 1
    with LogWriter(path, metadata, profile_toml) as log:
        for k in np.flatnonzero(samples.is_recorded).tolist():
            now_ns, begun_ns = int(tick_ns[k]), int(tick_ns[k] + lateness_ns[k])
            sweep, latched = int(sweep_ns[k]), int(latched_ns[k])
            newest = {
                "laser/primary": int(newest_sweep_ns[k]),
                "encoders": int(newest_latched_ns[k]),
                "rfid": int(round_ns[k]),
            }
            sent = [(topics.TICK, tick_message(k, now_ns, begun_ns, newest), begun_ns, k)]
            if samples.has_scan[k]:
                sent.append(
                    (
                        topics.PRIMARY_SCAN,
                        scan_message(sweep, samples.ranges[k], samples.scanner),
                        sweep,
                        int(scan_number[k]),
                    )
                )
            if samples.has_joints[k]:
                joints = joint_message(latched, names, samples.positions[k])
                sent.append((topics.JOINT_STATES, joints, latched, int(joint_number[k])))
            sent.append((topics.TAGS, tags_message(now_ns, start_ns, reads.get(k, [])), now_ns, k))
            for topic, message, stamp_ns, sequence in sent:
                log.write(topic.name, topic.msgtype, messages.encode(message), now_ns, stamp_ns, sequence)


def tick_message(index: int, scheduled_ns: int, begun_ns: int, newest_ns: dict[str, int]) -> object:
    states = [
        messages.SensorState(name=name, state=messages.STALE if age_s > STALE_S else messages.OK, age=age_s)
        for name, age_s in ((name, (scheduled_ns - stamp_ns) * 1e-9) for name, stamp_ns in newest_ns.items())
    ]
    return messages.Tick(
        header=messages.header(begun_ns, ""),
        index=index,
        scheduled=messages.to_time(scheduled_ns),
        lateness=(begun_ns - scheduled_ns) * 1e-9,
        sensors=states,
    )


def scan_message(stamp_ns: int, ranges: NDArray[np.float32], scanner: Scanner) -> object:
    angles = sensors.beam_angles(scanner)
    return messages.LaserScan(
        header=messages.header(stamp_ns, "laser_primary"),
        angle_min=float(angles[0]),
        angle_max=float(angles[-1]),
        angle_increment=float(np.radians(scanner.increment_deg)),
        time_increment=sensors.beam_period_s(scanner),
        scan_time=sensors.SWEEP_PERIOD_S,
        range_min=0.016,
        range_max=scanner.range_m,
        ranges=ranges,
        intensities=np.empty(0, dtype=np.float32),
    )


def joint_message(stamp_ns: int, names: list[str], positions: Array) -> object:
    nothing = np.empty(0)
    return messages.JointState(
        header=messages.header(stamp_ns, ""), name=names, position=positions, velocity=nothing, effort=nothing
    )


def tags_message(stamp_ns: int, start_ns: int, readings: list[sensors.TagReading]) -> object:
    reads = [
        messages.TagRead(
            stamp=messages.to_time(start_ns + round(reading.time_s * 1e9)),
            epc=reading.epc,
            antenna=0,
            count=reading.count,
            rssi=float("nan"),
        )
        for reading in readings
    ]
    return messages.TagReads(header=messages.header(stamp_ns, "rfid"), reads=reads)


def write_truth(path: Path, drive: Drive, samples: Samples, start_ns: int) -> None:
    """TUM lines at every tick, every sweep's first ray and every latching of the encoders, ascending."""
    times = (samples.tick_s, samples.sweep_s, samples.latched_s)
    stamps = np.unique(np.concatenate([stamps_of(start_ns, time_s) for time_s in times]))
    poses = drive.poses_at((stamps - start_ns) * 1e-9)
    with path.open("w", encoding="ascii") as file:
        for stamp, (x, y, heading) in zip(stamps.tolist(), poses.tolist(), strict=True):
            seconds, nanoseconds = divmod(stamp, 10**9)
            qz, qw = np.sin(heading / 2), np.cos(heading / 2)
            file.write(f"{seconds}.{nanoseconds:09d} {x:.6f} {y:.6f} 0 0 0 {qz:.9f} {qw:.9f}\n")
