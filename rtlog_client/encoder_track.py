"""What a vehicle's encoders showed during a recorded drive, and in between.

In: a recording's joint states; or, of other systems, `/odom`, from which follows what the encoders of the profile's
vehicle would have shown on the same way. Out: an `EncoderTrack`. All times are nanoseconds UTC of the recording.

The vehicle rolls on an arc from pose to pose, as `processing.odometry` has it the other way round; what its odometry
slid to the side, no wheel can show.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hw_profiles.errors import BadInputError
from hw_profiles.profile import Profile, Vehicle
from rtlog_client.log_file import read_info, read_messages
from rtlog_server.messages import decode, to_ns
from rtlog_server.topics import JOINT_STATES, ODOMETRY

Array = NDArray[np.float64]
STANDING_M = 1e-4  # a shorter step tells nothing of the steering
TURN_RAD = np.pi + 0.01  # angles that stay within it are told modulo a turn


@dataclass(frozen=True, slots=True)
class EncoderTrack:
    start_ns: int
    elapsed_ns: Array  # (N,) since the start, ascending; a float cannot hold the nanoseconds since 1970
    positions_rad: dict[str, Array]  # name: (N,), without jumps at ±π

    def angle(self, name: str, recorded_ns: int) -> float:
        """Linear from reading to reading; before the first and after the last the wheel stands still."""
        return float(np.interp(recorded_ns - self.start_ns, self.elapsed_ns, self.positions_rad[name]))


def read_encoder_track(recording: Path, profile: Profile) -> EncoderTrack:
    """The whole recording's. Raises: BadInputError: it lacks an encoder of the profile, or any motion at all."""
    topics = read_info(recording).message_counts
    if topics.get(JOINT_STATES.name):
        return _read_joint_states(recording, [encoder.name for encoder in profile.encoders])
    if topics.get(ODOMETRY.name):
        return _read_odometry(recording, profile)
    raise BadInputError(f"{recording}: neither {JOINT_STATES.name} nor {ODOMETRY.name}, and the profile has encoders")


def _read_joint_states(recording: Path, names: list[str]) -> EncoderTrack:
    stamps: list[int] = []
    rows: list[list[float]] = []
    lacking = ""
    for message in read_messages(recording, [JOINT_STATES.name]):
        state = decode(message.data, message.msgtype)
        position = dict(zip(state.name, state.position, strict=False))
        if missing := [name for name in names if name not in position]:
            there = ", ".join(state.name)
            lacking = f"{recording}: {JOINT_STATES.name} lacks {', '.join(missing)}; it has {there}"
            continue
        stamps.append(to_ns(state.header.stamp))
        rows.append([position[name] for name in names])
    if not rows:
        raise BadInputError(lacking)
    columns = np.array(rows).T
    return _track(stamps, dict(zip(names, [np.array(column) for column in columns], strict=True)))


def _read_odometry(recording: Path, profile: Profile) -> EncoderTrack:
    stamps: list[int] = []
    rows: list[tuple[float, float, float]] = []
    for message in read_messages(recording, [ODOMETRY.name]):
        odometry = decode(message.data, message.msgtype)
        position, q = odometry.pose.pose.position, odometry.pose.pose.orientation
        yaw = np.arctan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y * q.y + q.z * q.z))
        stamps.append(to_ns(odometry.header.stamp))
        rows.append((position.x, position.y, yaw))
    poses = np.array(rows)[np.argsort(stamps, kind="stable")]
    return _track(sorted(stamps), encoder_angles(profile, poses))


def _track(stamps: list[int], positions_rad: dict[str, Array]) -> EncoderTrack:
    start_ns = min(stamps)
    elapsed_ns = np.array([stamp - start_ns for stamp in stamps], np.float64)
    ascending = np.argsort(elapsed_ns, kind="stable")
    steady = {name: _unwrapped(angles[ascending]) for name, angles in positions_rad.items()}
    return EncoderTrack(start_ns, elapsed_ns[ascending], steady)


def _unwrapped(angles: Array) -> Array:
    """Without jumps, if they are told within a turn; a wheel that counts on may have turned far in a gap."""
    return np.unwrap(angles) if np.abs(angles).max() <= TURN_RAD else angles


def encoder_angles(profile: Profile, poses: Array) -> dict[str, Array]:
    """What each encoder of the profile would have shown at poses (N, 3) [m, m, rad]: name → (N,) rad, wheels from 0."""
    vehicle = profile.vehicle
    assert vehicle is not None  # parse_profile has checked it: there are encoders
    steps, turns = _arcs(poses)
    return {
        encoder.name: _angles(encoder.role, encoder.wheel_radius_m, vehicle, steps, turns)
        for encoder in profile.encoders
    }


def _arcs(poses: Array) -> tuple[Array, Array]:
    """Distance along the arc [m] and turn [rad] from pose to pose, each (N - 1,)."""
    turns = np.angle(np.exp(1j * np.diff(poses[:, 2])))
    middle = poses[:-1, 2] + turns / 2
    delta = np.diff(poses[:, :2], axis=0)
    chords = np.cos(middle) * delta[:, 0] + np.sin(middle) * delta[:, 1]
    return chords / np.sinc(turns / (2 * np.pi)), turns


def _angles(role: str, radius_m: float | None, vehicle: Vehicle, steps: Array, turns: Array) -> Array:
    if role == "steering":
        return _steering(vehicle.wheelbase_m or 0.0, steps, turns)
    rolled = {
        "left_wheel": lambda: steps - turns * (vehicle.track_width_m or 0.0) / 2,
        "right_wheel": lambda: steps + turns * (vehicle.track_width_m or 0.0) / 2,
        "drive_wheel": lambda: _driven(vehicle, steps, turns),
    }[role]()
    return np.concatenate([[0.0], np.cumsum(rolled)]) / (radius_m or 1.0)


def _driven(vehicle: Vehicle, steps: Array, turns: Array) -> Array:
    if vehicle.drive_axle == "rear":
        return steps
    return np.copysign(np.hypot(steps, (vehicle.wheelbase_m or 0.0) * turns), steps)


def _steering(wheelbase_m: float, steps: Array, turns: Array) -> Array:
    """(N,) the mean of the steps before and after; it stays where it was while the vehicle stands."""
    moving = np.abs(steps) > STANDING_M
    angles = np.where(moving, np.arctan(wheelbase_m * turns / np.where(moving, steps, 1.0)), 0.0)
    newest = np.maximum.accumulate(np.where(moving, np.arange(len(steps)), -1))
    held = np.where(newest >= 0, angles[newest], 0.0)
    return (np.append(held[:1], held) + np.append(held, held[-1:])) / 2
