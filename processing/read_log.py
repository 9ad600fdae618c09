"""Recording → arrays: SI, radians, one clock. The door of `processing`: what is wrong with a file is said here.

In: an MCAP recording, ours or another system's (`/scan` for the primary laser, `/odom` for encoders, any beam count,
stamps that jitter or run backwards now and then). Out: a `Run`. Stamps are header stamps: nanoseconds UTC of the
measurement itself, kept as they are for the output. Times, in seconds since `epoch_ns`, are what the stages reckon
with: they rise from message to message in the order of the recording, because where stamps run backwards it is the
order that is true.
"""

import hashlib
from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hw_profiles.errors import BadInputError
from hw_profiles.profile import ROLES, Profile, parse_profile
from processing.read_scans import ScanReader, Scans
from rtlog_client.log_file import LogInfo, read_info, read_messages
from rtlog_server.messages import decode, to_ns
from rtlog_server.topics import BY_NAME, JOINT_STATES, ODOMETRY, PRIMARY_SCAN, TAGS, TICK

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]

SCAN_TOPICS = (PRIMARY_SCAN.name, "/scan")
BARE_PROFILE = Profile(schema=1, name="scanner at the vehicle's origin")


@dataclass(frozen=True, slots=True)
class TagReadings:
    """k reads in order of time."""

    times: Array  # (k,) s
    epcs: NDArray[np.str_]  # (k,)


@dataclass(frozen=True, slots=True)
class Run:
    run_id: str
    sha256: str
    profile: Profile
    scans: Scans
    scan_ticks: NDArray[
        np.int64
    ]  # (n,) the tick of each scan, counted from the recording's first; its own number without ticks
    epoch_ns: int  # where times count from
    motion_ns: Stamps  # (m,) stamps of the encoders or of /odom
    motion_times: Array  # (m,) s, strictly rising
    wheels: Array | None  # (m, 2) rad, in the order of the kinematics' ROLES; or
    odometry: Array | None  # (m, 3) poses of /odom, where that stands in for encoders
    tags: TagReadings
    ticks: int


def read_log(
    path: Path, profile: Profile | None = None, further: Sequence[Path] = (), scratch: Path | None = None
) -> Run:
    """Read a recording; `profile` stands in for a missing attachment, `further` are the parts of it that follow.

    With a `scratch` folder, the ranges of its scans stay in a file there; without, they are in memory.

    Raises:
        BadInputError: no recording, no laser in it, no odometry in it, no profile for its encoders, or messages that
            are not what their topics say.
    """
    info = _join([read_info(part) for part in (path, *further)])
    profile = _profile(path, info, profile)
    scan_topic = next((topic for topic in SCAN_TOPICS if info.message_counts.get(topic)), None)
    if scan_topic is None:
        raise BadInputError(f"{path}: no laser scans ({' or '.join(SCAN_TOPICS)}); there is nothing to map")
    encoder_topic = next((t for t in (JOINT_STATES.name, ODOMETRY.name) if info.message_counts.get(t)), None)
    if encoder_topic is None:
        raise BadInputError(f"{path}: neither {JOINT_STATES.name} nor {ODOMETRY.name}; the motion is unknown")
    for topic, wanted in ((scan_topic, PRIMARY_SCAN), (encoder_topic, BY_NAME[encoder_topic]), (TAGS.name, TAGS)):
        if (found := info.msgtypes.get(topic, wanted.msgtype)) != wanted.msgtype:
            raise BadInputError(f"{path}: {topic} holds {found}, not {wanted.msgtype}")
    if info.message_counts[scan_topic] < 2:
        raise BadInputError(f"{path}: {scan_topic} holds 1 scan; a drive needs more")
    if encoder_topic == JOINT_STATES.name and not profile.encoders:
        raise BadInputError(f"{path}: has encoders but no profile that explains them; name one with --profile")
    with (
        TemporaryDirectory() as nowhere,
        ScanReader(path, (scratch or Path(nowhere)) / f"{info.run_id}.ranges") as scans,
    ):
        return _read((path, *further), info, profile, (scan_topic, encoder_topic), scans, in_memory=scratch is None)


def _read(
    parts: tuple[Path, ...],
    info: LogInfo,
    profile: Profile,
    topics: tuple[str, str],
    scans: ScanReader,
    in_memory: bool,
) -> Run:
    (scan_topic, encoder_topic), path = topics, parts[0]
    motions: list[tuple[int, Any]] = []
    reads: list[tuple[int, str]] = []
    wheels = _wheels_of(profile) if encoder_topic == JOINT_STATES.name else _pose_of
    tick_log_times: list[int] = []
    for topic, log_time_ns, message in _decoded(parts, [TICK.name, scan_topic, encoder_topic, TAGS.name]):
        if topic == TICK.name:
            tick_log_times.append(log_time_ns)
        elif topic == scan_topic:
            scans.add(message, log_time_ns)
        elif topic == encoder_topic:
            value = wheels(message)
            if value is not None and np.all(np.isfinite(value)):
                motions.append((to_ns(message.header.stamp), value))
        else:
            reads.extend((to_ns(read.stamp), str(read.epc).upper()) for read in message.reads)
    if not motions:
        roles = [encoder.name for encoder in profile.encoders]
        raise BadInputError(f"{path}: no message on {encoder_topic} holds a reading of {' and '.join(roles)}")
    reads.sort()
    motion_ns = np.array([ns for ns, _ in motions], np.int64)
    motion = np.array([value for _, value in motions], np.float64)
    scan_ns = scans.stamps_ns
    rising_motion_ns, rising_scan_ns = rising_stamps(motion_ns), rising_stamps(scan_ns)
    if rising_motion_ns[0] > rising_scan_ns[-1] or rising_scan_ns[0] > rising_motion_ns[-1]:
        raise BadInputError(f"{path}: by their stamps, {scan_topic} and {encoder_topic} have no time in common")
    epoch_ns = int(min(rising_motion_ns[0], rising_scan_ns[0]))
    motion_times = np.asarray((rising_motion_ns - epoch_ns) * 1e-9, np.float64)
    scan_times = np.asarray((rising_scan_ns - epoch_ns) * 1e-9, np.float64)
    _take_over_times(scan_ns, scan_times, motion_ns, motion_times)
    have_wheels = encoder_topic == JOINT_STATES.name
    return Run(
        run_id=info.run_id,
        sha256=_digest(parts),
        profile=profile,
        scans=scans.scans(scan_times, in_memory),
        scan_ticks=scans.ticks(tick_log_times),
        epoch_ns=epoch_ns,
        motion_ns=motion_ns,
        motion_times=motion_times,
        wheels=motion if have_wheels else None,
        odometry=None if have_wheels else motion,
        tags=TagReadings(
            np.array([(ns - epoch_ns) * 1e-9 for ns, _ in reads], np.float64),
            np.array([epc for _, epc in reads], np.str_),
        ),
        ticks=info.message_counts.get(TICK.name, len(scan_ns)),
    )


def rising_stamps(stamps_ns: Stamps) -> Stamps:
    """Stamps (n,) that rise strictly, in the order of the recording.

    The longest rising run among the stamps is taken at its word; the others are spread evenly over the gaps in it that
    they were recorded in, or go on at the usual pace before its first and after its last.
    """
    believed, index = _longest_rising(stamps_ns), np.arange(len(stamps_ns))
    first, last = believed[0], believed[-1]
    since = stamps_ns[believed] - stamps_ns[first]
    spread = np.interp(index, believed, since)
    pace = np.median(np.diff(since) / np.diff(believed)) if len(believed) > 1 else 0.0
    spread += pace * (np.minimum(index - first, 0) + np.maximum(index - last, 0))
    rising = np.maximum.accumulate(np.round(spread).astype(np.int64) - index) + index
    return np.asarray(stamps_ns[first] + rising, np.int64)


def _longest_rising(stamps_ns: Stamps) -> NDArray[np.int64]:
    """Indices of the longest strictly rising run, which may leave stamps out (Schensted 1961).

    Taken from the last stamp to the first, so that of two that contradict each other the earlier is believed.
    """
    firsts: list[int] = []  # negated: the highest stamp that a run of each length can begin with
    starts: list[int] = []  # and its index
    after = [-1] * len(stamps_ns)
    for k in range(len(stamps_ns) - 1, -1, -1):
        negated = -int(stamps_ns[k])
        length = bisect_left(firsts, negated)
        after[k] = starts[length - 1] if length else -1
        firsts[length : length + 1], starts[length : length + 1] = [negated], [k]
    run = [starts[-1]]
    while after[run[-1]] >= 0:
        run.append(after[run[-1]])
    return np.array(run, np.int64)


def _take_over_times(scan_ns: Stamps, scan_times: Array, motion_ns: Stamps, motion_times: Array) -> None:
    """A scan with the very stamp of an odometry message belongs to that message, whatever backward stamps did to
    either.
    """
    order = np.argsort(motion_ns, kind="stable")
    at = np.minimum(np.searchsorted(motion_ns[order], scan_ns), len(order) - 1)
    same = motion_ns[order[at]] == scan_ns
    scan_times[same] = motion_times[order[at[same]]]
    steps = np.arange(len(scan_ns)) * 1e-9
    scan_times[:] = np.maximum.accumulate(scan_times - steps) + steps


def _profile(path: Path, info: LogInfo, fallback: Profile | None) -> Profile:
    """A profile named by the user wins over the one inside: they name it because that one is wrong or missing."""
    if fallback is not None:
        return fallback
    if info.profile_toml is not None:
        return parse_profile(info.profile_toml, source=f"inside {path}")
    return BARE_PROFILE


def _join(parts: list[LogInfo]) -> LogInfo:
    """What the parts of a recording say together."""
    counts = Counter[str]()
    for part in parts:
        counts.update(part.message_counts)
    types = {topic: msgtype for part in parts for topic, msgtype in part.msgtypes.items()}
    return replace(parts[0], message_counts=dict(counts), msgtypes=types)


def _digest(paths: Sequence[Path]) -> str:
    """SHA-256 of the file; of several parts, of all of them in order."""
    found = hashlib.sha256()
    for path in paths:
        with path.open("rb") as file:
            while block := file.read(1 << 20):
                found.update(block)
    return found.hexdigest()


def _decoded(paths: Sequence[Path], topics: list[str]) -> Iterator[tuple[str, int, Any]]:
    for path in paths:
        for message in read_messages(path, topics):
            try:
                inside = None if message.topic == TICK.name else decode(message.data, message.msgtype)
                yield message.topic, message.log_time_ns, inside
            except (ValueError, KeyError) as error:
                raise BadInputError(f"{path}: {message.topic} at {message.log_time_ns} ns: {error}") from error


def _wheels_of(profile: Profile) -> Callable[[Any], tuple[float, float] | None]:
    """Reads both encoders of a JointState in the order of their roles; None where one is missing."""
    assert profile.vehicle is not None  # a profile with encoders was checked to have one
    first, second = (profile.encoder(role).name for role in ROLES[profile.vehicle.kinematics])

    def read(message: Any) -> tuple[float, float] | None:
        names = list(message.name)
        if first not in names or second not in names or len(message.position) != len(names):
            return None
        return float(message.position[names.index(first)]), float(message.position[names.index(second)])

    return read


def _pose_of(message: Any) -> tuple[float, float, float]:
    position, q = message.pose.pose.position, message.pose.pose.orientation
    return position.x, position.y, float(np.arctan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y * q.y + q.z * q.z)))
