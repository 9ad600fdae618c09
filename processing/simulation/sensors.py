"""Sensors: what laser, wheel encoders and RFID reader give of a drive, sampled at ticks as the server samples them.

In: the true drive, walls, tags, the noise. Out: arrays, one row a tick. Times are seconds since the run's first tick.

    laser    sweeps at 50 Hz of its own phase; a tick gets the newest one that was complete by then
    wheels   rolled distance, by the true radius, with slip; the profile's radius is what processing will believe
    RFID     inventory rounds at 25 Hz; the paper's model (section 2.2): constant probability within the range, else 0
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hw_profiles.profile import Encoder, Mount, Profile
from processing.geometry import compose
from processing.simulation.drive import Drive
from processing.simulation.hazard_traffic import Obstacle
from processing.simulation.raycast import SegmentGrid, cast
from processing.simulation.world import Noise, Scanner, Tag

Array = NDArray[np.float64]
SWEEP_PERIOD_S = 0.02  # LMS111 at 50 Hz
TRANSFER_S = 0.0035  # from the last beam to the host, as measured on a device
ENCODER_LATENCY_S = 0.012  # from latching the positions to the end of their transfer
ROUND_PERIOD_S = 0.04
CHUNK_SWEEPS = 500


@dataclass(frozen=True, slots=True)
class TagReading:
    """The reads of one tag between two ticks."""

    tick: int
    epc: str
    time_s: float  # of the last read
    count: int


def beam_angles(scanner: Scanner) -> Array:
    """Bearings (beams,) in the scanner's frame, ascending."""
    half_deg = scanner.field_of_view_deg / 2
    return np.asarray(np.radians(np.linspace(-half_deg, half_deg, scanner.beams)))


def beam_period_s(scanner: Scanner) -> float:
    """From a beam to the next: the mirror turns 360° a sweep."""
    return SWEEP_PERIOD_S / (360 / scanner.increment_deg)


def sweep_times(tick_s: Array, phase_s: float, scanner: Scanner) -> Array:
    """First-ray times (n,) of the newest sweeps that the host has whole at the ticks (n,)."""
    sweep_s = (scanner.beams - 1) * beam_period_s(scanner)
    sweep = np.floor((tick_s - phase_s - sweep_s - TRANSFER_S) / SWEEP_PERIOD_S)
    return np.asarray(phase_s + sweep * SWEEP_PERIOD_S)


def simulate_sweeps(
    drive: Drive,
    grid: SegmentGrid,
    scanner: Scanner,
    mount: Mount,
    start_s: Array,
    range_noise_m: float,
    generator: np.random.Generator,
    obstacles: Sequence[Obstacle] = (),
) -> NDArray[np.float32]:
    """Ranges (n, beams) in metres of sweeps that begin at `start_s` (n,), in whole millimetres; +inf beyond its range.

    Each beam leaves from where the laser is at its own time, so a sweep of a moving vehicle is distorted as a real one.
    """
    ranges = np.empty((len(start_s), scanner.beams), dtype=np.float32)
    since_first_s, bearings = beam_period_s(scanner) * np.arange(scanner.beams), beam_angles(scanner)
    mounted = np.array([mount.x_m, mount.y_m, np.radians(mount.yaw_deg)])
    for first in range(0, len(start_s), CHUNK_SWEEPS):
        chunk = slice(first, first + CHUNK_SWEEPS)
        time_s = start_s[chunk, None] + since_first_s
        laser = compose(drive.poses_at(time_s), mounted)
        angles = laser[..., 2] + bearings
        distances = cast(grid, laser[..., :2].reshape(-1, 2), angles.ravel(), scanner.range_m).reshape(angles.shape)
        for obstacle in obstacles:
            beams = np.concatenate([laser[..., :2], angles[..., None]], axis=-1)
            distances = np.minimum(distances, obstacle.distances(beams, time_s))
        distances += generator.normal(0.0, range_noise_m, distances.shape)
        millimetres = np.maximum(np.round(distances * 1000), 1.0)
        ranges[chunk] = np.where(distances <= scanner.range_m, millimetres / 1000, np.inf)
    return ranges


def simulate_encoders(
    drive: Drive, profile: Profile, time_s: Array, noise: Noise, generator: np.random.Generator
) -> Array:
    """Joint positions (n, encoders) in radians, in the profile's order, latched at `time_s` (n,)."""
    columns = []
    for encoder in profile.encoders:
        if encoder.role == "steering":
            angle = steering_angle(drive, profile, time_s) + np.radians(noise.steering_zero_error_deg)
            angle = angle + np.radians(noise.steering_deg) * generator.standard_normal(len(time_s))
        else:
            angle = _wheel_angle(drive, profile, encoder, time_s, noise, generator)
        count = 2 * np.pi / encoder.counts_per_turn
        columns.append(np.floor(angle / count + 0.5) * count)
    return np.column_stack(columns)


def steering_angle(drive: Drive, profile: Profile, time_s: Array) -> Array:
    """The front wheel's angle (n,) on the true path: tan δ = L κ, κ the curvature at the rear axle."""
    assert profile.vehicle is not None
    return np.asarray(np.arctan((profile.vehicle.wheelbase_m or 0.0) * drive.at(time_s, drive.curvature)))


def rolled_distance(drive: Drive, profile: Profile, role: str, track_error: float, time_s: Array) -> Array:
    """How far the wheel of that role rolls without slip from the start of the drive to each time (n,), in metres."""
    assert profile.vehicle is not None
    if role in ("left_wheel", "right_wheel"):
        half_track = (profile.vehicle.track_width_m or 0.0) * (1 + track_error) / 2
        turned = drive.pose[:, 2] - drive.pose[0, 2]
        rolled = drive.distance_m + (half_track if role == "right_wheel" else -half_track) * turned
    elif profile.vehicle.drive_axle == "rear":
        rolled = drive.distance_m
    else:  # the front wheel's way is longer: ds / cos δ
        slope = np.hypot(1.0, (profile.vehicle.wheelbase_m or 0.0) * drive.curvature)
        rolled = np.append(0.0, np.cumsum(np.diff(drive.distance_m) * (slope[1:] + slope[:-1]) / 2))
    return drive.at(time_s, rolled)


def _wheel_angle(
    drive: Drive, profile: Profile, encoder: Encoder, time_s: Array, noise: Noise, generator: np.random.Generator
) -> Array:
    """The true rotation (n,) of a wheel, from an arbitrary position at power-on."""
    rolled = rolled_distance(drive, profile, encoder.role, noise.track_width_error_percent / 100, time_s)
    steps = np.diff(rolled, prepend=rolled[0])
    slip = noise.slip_m_per_sqrt_m * np.sqrt(np.abs(steps)) * generator.standard_normal(len(steps))
    radius_m = (encoder.wheel_radius_m or 0.0) * (1 + noise.wheel_radius_error_percent.get(encoder.role, 0.0) / 100)
    return np.asarray((rolled + np.cumsum(slip)) / radius_m + generator.uniform(0.0, 2 * np.pi))


def simulate_reads(
    drive: Drive,
    tags: list[Tag],
    places: Array,
    tick_s: Array,
    phase_s: float,
    missed_pass_probability: float,
    generator: np.random.Generator,
) -> tuple[Array, list[TagReading]]:
    """What the reader found between ticks, for tags at `places` (m, 2).

    Returns:
        The times (n,) of the last inventory round before each tick, and the readings in order of ticks and tags.
    """
    rounds = np.arange(np.floor((tick_s[-1] - phase_s) / ROUND_PERIOD_S) + 1) * ROUND_PERIOD_S + phase_s
    rounds = rounds[rounds > tick_s[0] - (tick_s[1] - tick_s[0])]
    tick = np.searchsorted(tick_s, rounds)
    position = drive.poses_at(rounds)[:, :2]
    readings = []
    for tag, place in zip(tags, places, strict=True):
        within = np.linalg.norm(position - place, axis=1) <= tag.read_range_m
        within &= (rounds >= tag.from_s) & (rounds <= tag.until_s)
        passes = np.cumsum(np.diff(within, prepend=False) & within)  # numbers the stays within the range from 1
        missed = generator.random(passes[-1] + 1) < missed_pass_probability
        read = within & ~missed[passes] & (generator.random(len(rounds)) < tag.read_probability)
        for k in np.unique(tick[read]).tolist():
            found = rounds[read & (tick == k)]
            readings.append(TagReading(k, tag.epc, float(found[-1]), len(found)))
    last_round = rounds[np.searchsorted(rounds, tick_s, side="right") - 1]
    return last_round, sorted(readings, key=lambda reading: reading.tick)
