"""Recordings, before they are read: which files are one run, whether they are fit to be mapped, how to share them out.

In: recordings in any order; a recorder may split a run into parts, which share its run id. Out: a `Source` for each
run, and windows of it. Law: what is one run is told by what files say of themselves, never by their names, and what
cannot be told is refused before any work.
"""

from collections import Counter
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

from hw_profiles.errors import BadInputError
from hw_profiles.profile import Profile, parse_profile
from rtlog_client.log_file import FOREVER_NS, LogInfo, read_info
from rtlog_server.topics import BY_NAME, JOINT_STATES, ODOMETRY, PRIMARY_SCAN, TAGS

SCAN_TOPICS = (PRIMARY_SCAN.name, "/scan")
BARE_PROFILE = Profile(schema=1, name="scanner at the vehicle's origin")
MAX_SHARED_NS = 10**9  # by so much two parts may overlap: messages of one tick on either side of the cut


@dataclass(frozen=True, slots=True)
class Source:
    """A recording that is fit to be read, and what there is to know before it is."""

    parts: tuple[Path, ...]
    cuts_ns: tuple[tuple[int, ...], ...]  # of each part: log times between which it can be read by itself
    info: LogInfo  # of all parts together
    profile: Profile
    scan_topic: str
    encoder_topic: str

    @property
    def has_wheels(self) -> bool:
        return self.encoder_topic == JOINT_STATES.name


@dataclass(frozen=True, slots=True)
class Window:
    """A stretch of one part, to be read by itself: log times from `start_ns` to before `end_ns`."""

    source: Source
    number: int
    path: Path
    start_ns: int
    end_ns: int


def group_parts(recordings: list[Path]) -> list[tuple[Path, ...]]:
    """The runs in the order of their first mention, each with its parts.

    Raises:
        BadInputError: a file is no recording, one stands there twice, two runs have one name, or the name is not fit to
            be that of a file.
    """
    runs: dict[str, list[tuple[Path, LogInfo]]] = {}
    for path in recordings:
        info = read_info(path)
        if info.run_id in ("", ".", "..") or "/" in info.run_id:
            raise BadInputError(f"{path}: the run is called {info.run_id!r}, which no file can be")
        runs.setdefault(info.run_id, []).append((path, info))
    for run_id, parts in runs.items():
        parts.sort(key=lambda part: (part[1].start_ns, part[1].end_ns))
        for (a, before), (b, after) in pairwise(parts):
            if a.resolve() == b.resolve():
                raise BadInputError(f"{a} is named twice")
            boots = [info.metadata.get("boot_id") for info in (before, after)]
            if boots[0] == boots[1] and after.start_ns < before.end_ns - MAX_SHARED_NS:
                raise BadInputError(f"{a} and {b} hold the same time of run {run_id}; which of them is it?")
            if boots[0] != boots[1] or boots[0] is None:
                raise BadInputError(f"{a} and {b} are both called run {run_id}, and are not parts of one boot's run")
    return [tuple(path for path, _ in parts) for parts in runs.values()]


def survey(parts: tuple[Path, ...], profile: Profile | None) -> Source:
    """What a recording holds; its parts in order of time.

    Raises:
        BadInputError: no recording, no laser in it, no odometry in it, no profile for its encoders.
    """
    infos = [read_info(part) for part in parts]
    path, info = parts[0], _join(infos)
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
    cuts_ns = tuple(part.cuts_ns for part in infos)
    return Source(parts, cuts_ns, info, profile, scan_topic, encoder_topic)


def cut_windows(source: Source) -> list[Window]:
    """All of a recording, so that several processes can read it."""
    spans = [
        (path, start, end)
        for path, cuts_ns in zip(source.parts, source.cuts_ns, strict=True)
        for start, end in pairwise([0, *cuts_ns, FOREVER_NS])
    ]
    return [Window(source, number, *span) for number, span in enumerate(spans)]


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
