"""Recording → arrays: SI, radians, one clock. The door of `processing`: what is wrong with a file is said here.

In: an MCAP recording, ours or another system's (`/scan` for the primary laser, `/odom` for encoders, any beam count,
stamps that jitter or run backwards now and then). Out: a `Run`. Stamps are header stamps: nanoseconds UTC of the
measurement itself, kept as they are for the output. Times, in seconds since `epoch_ns`, are what the stages reckon
with: they rise from message to message in the order of the recording, because where stamps run backwards it is the
order that is true.
"""

import hashlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hw_profiles.errors import BadInputError
from hw_profiles.profile import ROLES, Profile
from processing.read_scans import ReadScans, ScanReader, Scans, join_scans
from processing.recordings import Source, Window, cut_windows, group_parts, survey
from processing.stamps import rising_stamps, take_over_times
from processing.workers import Workers
from rtlog_client.log_file import read_messages
from rtlog_server.messages import decode, to_ns
from rtlog_server.topics import TAGS, TICK

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]

MIN_SCANS = 10  # to be mapped: a second


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
    scan_ticks: Stamps  # (n,) the tick of each scan, counted from the recording's first; without ticks its own number
    epoch_ns: int  # where times count from
    motion_ns: Stamps  # (m,) stamps of the encoders or of /odom
    motion_times: Array  # (m,) s, strictly rising
    wheels: Array | None  # (m, 2) rad, in the order of the kinematics' ROLES; or
    odometry: Array | None  # (m, 3) poses of /odom, where that stands in for encoders
    tags: TagReadings
    ticks: int
    stamped: tuple[Array, Array] | None = None  # (n,) and (m,) s: what the stamps of scans and odometry say, where the
    # times were put right


@dataclass(frozen=True, slots=True)
class Readings:
    """What a window holds, in the order of the recording."""

    tick_log_times_ns: Stamps  # (t,)
    scans: ReadScans
    motion_ns: Stamps  # (m,) of the encoders or of /odom
    motions: Array  # (m, 2) both wheels [rad], or (m, 3) poses
    reads: list[tuple[int, str]]  # stamp [ns], EPC


def read_log(
    path: Path, profile: Profile | None = None, further: Sequence[Path] = (), scratch: Path | None = None
) -> Run:
    """Read a recording; `profile` stands in for a missing attachment, `further` are the parts of it that follow.

    With a `scratch` folder, the ranges of its scans stay in a file there; without, they are in memory.

    Raises:
        BadInputError: as `survey` and `read_window`.
    """
    source = survey((path, *further), profile)
    if scratch is not None:
        return join_windows(source, [read_window(window, scratch) for window in cut_windows(source)], scratch)
    with TemporaryDirectory() as nowhere:
        run = read_log(path, profile, further, Path(nowhere))
        return replace(run, scans=replace(run.scans, ranges=run.scans.ranges[:]))


def begin_reading(
    recordings: list[Path], profile: Profile | None, scratch: Path, work: Workers
) -> Callable[[], list[Run]]:
    """Begin to read all of them; what is returned waits for the end of it. The ranges stay in the folder `scratch`.

    Raises (and what is returned, too):
        BadInputError: a recording is unfit, or it cannot be told which run it is.
        RTLogError: the disk is full, or a process died.
    """
    sources = [survey(parts, profile) for parts in group_parts(recordings)]
    windows = work.begin_groups("recordings", partial(read_window, scratch=scratch), map(cut_windows, sources))
    return lambda: [_long_enough(join_windows(*read, scratch), read[0]) for read in zip(sources, windows, strict=True)]


def _long_enough(run: Run, source: Source) -> Run:
    if len(run.scans.times) < MIN_SCANS:
        raise BadInputError(f"{source.parts[0]}: {len(run.scans.times)} scans are too few to map")
    return run


def read_window(window: Window, scratch: Path) -> Readings:
    """Read it; the ranges of its scans go to a file in the folder `scratch`.

    Raises:
        BadInputError: messages that are not what their topics say.
        RTLogError: the disk is full.
    """
    source = window.source
    motion_ns: list[int] = []
    motions: list[tuple[float, ...]] = []
    reads: list[tuple[int, str]] = []
    motion_of = _wheels_of(source.profile) if source.has_wheels else _pose_of
    tick_log_times: list[int] = []
    ranges = scratch / f"{source.info.run_id}.{window.number}.ranges"
    with ScanReader(ranges, source.profile.lasers.primary) as scans:
        for topic, log_time_ns, message in _decoded(
            window, [TICK.name, source.scan_topic, source.encoder_topic, TAGS.name]
        ):
            if topic == TICK.name:
                tick_log_times.append(log_time_ns)
            elif topic == source.scan_topic:
                scans.add(message, log_time_ns)
            elif topic == source.encoder_topic:
                motion = motion_of(message)
                if motion is not None and np.all(np.isfinite(motion)):
                    motion_ns.append(to_ns(message.header.stamp))
                    motions.append(motion)
            else:
                reads.extend((to_ns(read.stamp), str(read.epc).upper()) for read in message.reads)
        return Readings(
            np.array(tick_log_times, np.int64),
            scans.finish(),
            np.array(motion_ns, np.int64),
            np.array(motions, np.float64).reshape(-1, 2 if source.has_wheels else 3),
            reads,
        )


def join_windows(source: Source, windows: Sequence[Readings], scratch: Path) -> Run:
    """The whole recording, from all its windows.

    Raises:
        BadInputError: what it holds does not fit together.
        RTLogError: the disk is full.
    """
    path, profile = source.parts[0], source.profile
    motion_ns = np.concatenate([window.motion_ns for window in windows])
    motion = np.concatenate([window.motions for window in windows])
    reads = sorted(read for window in windows for read in window.reads)
    if not len(motion_ns):
        roles = [encoder.name for encoder in profile.encoders]
        raise BadInputError(f"{path}: no message on {source.encoder_topic} holds a reading of {' and '.join(roles)}")
    read = [window.scans for window in windows]
    scans = join_scans(path, read, profile.lasers.primary, scratch / f"{source.info.run_id}.ranges")
    rising_motion_ns, rising_scan_ns = rising_stamps(motion_ns), rising_stamps(scans.stamps_ns)
    if rising_motion_ns[0] > rising_scan_ns[-1] or rising_scan_ns[0] > rising_motion_ns[-1]:
        what = f"{source.scan_topic} and {source.encoder_topic} have no time in common"
        raise BadInputError(f"{path}: by their stamps, {what}")
    epoch_ns = int(min(rising_motion_ns[0], rising_scan_ns[0]))
    motion_times = np.asarray((rising_motion_ns - epoch_ns) * 1e-9, np.float64)
    scan_times = np.asarray((rising_scan_ns - epoch_ns) * 1e-9, np.float64)
    take_over_times(scans.stamps_ns, scan_times, motion_ns, motion_times)
    tick_log_times_ns = np.concatenate([window.tick_log_times_ns for window in windows])
    return Run(
        run_id=source.info.run_id,
        sha256=_digest(source.parts),
        profile=profile,
        scans=replace(scans, times=scan_times),
        scan_ticks=ticks_of(np.concatenate([window.scans.log_times_ns for window in windows]), tick_log_times_ns),
        epoch_ns=epoch_ns,
        motion_ns=motion_ns,
        motion_times=motion_times,
        wheels=motion if source.has_wheels else None,
        odometry=None if source.has_wheels else motion,
        tags=TagReadings(
            np.array([(ns - epoch_ns) * 1e-9 for ns, _ in reads], np.float64),
            np.array([epc for _, epc in reads], np.str_),
        ),
        ticks=source.info.message_counts.get(TICK.name, len(scans.stamps_ns)),
    )


def ticks_of(scan_log_times_ns: Stamps, tick_log_times_ns: Stamps) -> Stamps:
    """The tick of each scan, counted from the first of the recording; without ticks its own number."""
    if not len(tick_log_times_ns):
        return np.arange(len(scan_log_times_ns))
    return np.searchsorted(tick_log_times_ns, scan_log_times_ns, side="right") - 1


def _digest(paths: Sequence[Path]) -> str:
    """SHA-256 of the file; of several parts, of all of them in order."""
    found = hashlib.sha256()
    for path in paths:
        with path.open("rb") as file:
            while block := file.read(1 << 20):
                found.update(block)
    return found.hexdigest()


def _decoded(window: Window, topics: list[str]) -> Iterator[tuple[str, int, Any]]:
    for message in read_messages(window.path, topics, window.start_ns, window.end_ns):
        try:
            inside = None if message.topic == TICK.name else decode(message.data, message.msgtype)
            yield message.topic, message.log_time_ns, inside
        except (ValueError, KeyError) as error:
            raise BadInputError(f"{window.path}: {message.topic} at {message.log_time_ns} ns: {error}") from error


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
