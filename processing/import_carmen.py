"""CARMEN logs → recordings.

In: a log, plain or gzip, of lines in driving order; all but L in metres and radians:

    ODOM x y theta tv rv accel ipc_time host logger_time
    FLASER n r1…rn x y theta odom_x odom_y odom_theta ipc_time host logger_time
    L x y theta laser_x laser_y laser_theta r1…rn time      centimetres: the base, then the laser ahead of it

Out: an MCAP recording of `/laser/primary/scan` and `/odom` with the log's own stamps (ipc_time: the clock of the
published relations), also where they run backwards; log_time keeps the order of the lines. Law: the same log gives the
same bytes. FLASER and ODOM logs put the laser at the vehicle's origin: their recording carries no profile. L lines say
where the laser sits; the recording carries a profile that says no more than that. The `O x y theta time`
lines between them are left out: on Wean Hall they run 0.11 s ahead of the poses of the L lines, and the two together
would drive to and fro.

Some copies have their stamps rounded until most lines share one; on those, and only on those, the lines of one stamp
are laid out in their order over the time up to the next stamp, at most `ROUNDED_STEP_S` apart; the counts tell it.
"""

import gzip
import itertools
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from importlib.metadata import version
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hw_profiles.errors import BadInputError
from processing.geometry import Array, relative
from rtlog_client.log_file import LogWriter
from rtlog_server.messages import LaserScan, Odometry, encode, header, typestore
from rtlog_server.topics import ODOMETRY, PRIMARY_SCAN

NO_RETURN_M = 80.0  # the SICK scanners of these logs say 81.9 m for "nothing there"
STEP_DEG = {180: 1.0, 181: 1.0, 360: 0.5, 361: 0.5}  # beams → angle between them; the first looks at -90°
ROUNDED_STEP_S = 0.1


@dataclass(frozen=True, slots=True)
class Line:
    """One line of the log, in metres, radians and nanoseconds of the log's clock."""

    number: int
    stamp_ns: int
    odometry: Array  # (3,) pose of the base
    ranges_m: Array | None  # (n,) of a scan
    laser: Array | None  # (3,) pose of the laser where the line tells it apart from the base


@dataclass(frozen=True, slots=True)
class ImportCounts:
    scans: int
    odometry: int
    backward_stamps: int  # lines that are stamped earlier than the line before
    spread_stamps: int  # lines whose stamp had been rounded away and was laid out anew
    skipped: dict[str, int]  # lines that were left out, by type


def import_carmen(log: Path, out: Path) -> ImportCounts:
    """Write the log as a recording.

    Raises:
        BadInputError: the log cannot be read, a line of it is malformed, it holds no scan, or `out` exists.
    """
    skipped: dict[str, int] = {}
    lines = list(parse_lines(log, skipped))
    if not any(line.ranges_m is not None for line in lines):
        found = ", ".join(sorted(skipped)[:5]) or "no lines of other types"
        raise BadInputError(f"{log}: no FLASER or L line, so this is no CARMEN log with scans (it holds {found})")
    original = np.array([line.stamp_ns for line in lines])
    stamps = spread_rounded(original, np.array([line.ranges_m is not None for line in lines]))
    metadata = {"vehicle": "carmen", "profile": "", "boot_id": "", "software": f"rtlog {version('rtlog')}"}
    scans = odometry = 0
    last: tuple[int, bytes] | None = None
    with LogWriter(out, metadata, mount_profile(log, lines)) as writer:
        for line, stamp_ns, log_time_ns in zip(
            lines, stamps.tolist(), np.maximum.accumulate(stamps).tolist(), strict=True
        ):
            pose = (stamp_ns, line.odometry.tobytes())
            if pose != last:  # loggers often repeat a scan's pose as an ODOM line
                message = encode(to_odometry(line, stamp_ns))
                writer.write(ODOMETRY.name, ODOMETRY.msgtype, message, log_time_ns, stamp_ns)
                odometry += 1
            last = pose
            if line.ranges_m is not None:
                message = encode(to_scan(line.ranges_m, stamp_ns))
                writer.write(PRIMARY_SCAN.name, PRIMARY_SCAN.msgtype, message, log_time_ns, stamp_ns)
                scans += 1
    return ImportCounts(
        scans,
        odometry,
        int(np.sum(np.diff(stamps) < 0)),
        int(np.sum(stamps != original)),
        dict(sorted(skipped.items())),
    )


def parse_lines(log: Path, skipped: dict[str, int]) -> Iterator[Line]:
    """The lines that hold a scan or odometry; the others are counted in `skipped` by their type.

    Raises:
        BadInputError: the file cannot be read, or a line is malformed: with its number.
    """
    parsers = {"ODOM": _parse_odom, "FLASER": _parse_flaser, "L": _parse_l}
    try:
        with log.open("rb") as file:
            is_gzip = file.read(2) == b"\x1f\x8b"
        with gzip.open(log, "rb") if is_gzip else log.open("rb") as file:
            for number, raw in enumerate(file, start=1):
                words = raw.decode("ascii", "replace").split()
                if not words or words[0].startswith("#"):
                    continue
                parser = parsers.get(words[0])
                if parser is None:
                    skipped[words[0][:32]] = skipped.get(words[0][:32], 0) + 1
                    continue
                try:
                    yield parser(number, words[1:])
                except (ValueError, InvalidOperation) as error:
                    reason = str(error) if isinstance(error, ValueError) else "the time is no number"
                    raise BadInputError(f"{log}, line {number}: {words[0]}: {reason}") from error
    except (EOFError, gzip.BadGzipFile, zlib.error) as error:
        raise BadInputError(f"{log}: the gzip stream is cut off or damaged ({error})") from error
    except OSError as error:
        raise BadInputError(f"{log}: {error.strerror or error}") from error


def _parse_odom(number: int, words: list[str]) -> Line:
    if len(words) != 9:
        raise ValueError(f"{len(words)} fields after the type; there must be 9")
    return Line(number, _stamp(words[6]), _pose(words[:3]), None, None)


def _parse_flaser(number: int, words: list[str]) -> Line:
    beams = int(words[0]) if words and words[0].isdigit() else -1
    if beams not in STEP_DEG:
        known = ", ".join(map(str, STEP_DEG))
        raise ValueError(f"{words[0] if words else 'no'} beams; their angles are known for {known} beams only")
    if len(words) != beams + 10:
        raise ValueError(f"{len(words)} fields after the type; {beams} beams need {beams + 10}")
    # x y theta before the odometry is the laser as some localization saw it, no mount: it is left alone
    return Line(number, _stamp(words[-3]), _pose(words[-6:-3]), _ranges(words[1 : beams + 1], 1.0), None)


def _parse_l(number: int, words: list[str]) -> Line:
    if len(words) - 7 not in STEP_DEG:
        known = ", ".join(str(beams + 7) for beams in STEP_DEG)
        raise ValueError(f"{len(words)} fields after the type; known are {known} (7 and one a beam)")
    return Line(number, _stamp(words[-1]), _pose(words[:3], 0.01), _ranges(words[6:-1], 0.01), _pose(words[3:6], 0.01))


def _stamp(word: str) -> int:
    """Nanoseconds of decimal seconds, exactly: a float of today's seconds is good for 0.2 µs only."""
    seconds = Decimal(word)
    if not 0 <= seconds < 2**31:
        raise ValueError(f"the time {word} lies outside 0 … 2^31 s, which a ROS stamp can hold")
    return int(seconds.scaleb(9).to_integral_value())


def _pose(words: list[str], metres: float = 1.0) -> Array:
    """A pose (3,) of x, y in units of `metres` and theta in radians."""
    pose = np.array([float(word) for word in words]) * [metres, metres, 1.0]
    if not np.isfinite(pose).all():
        raise ValueError(f"the pose {' '.join(words)} is not finite")
    return pose


def _ranges(words: list[str], metres: float) -> Array:
    """Ranges in metres as REP-117 wants them: +inf no return, NaN where the scanner gave nothing sensible."""
    ranges = np.array([float(word) for word in words]) * metres
    ranges[~(ranges > 0)] = np.nan
    ranges[ranges >= NO_RETURN_M] = np.inf
    return ranges


def spread_rounded(stamps: NDArray[np.int64], is_scan: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Stamps (n,) [ns] as they are; where most were rounded away, those of each run of equal ones laid out in order.

    An ODOM line and the scan that follows it under the same stamp count as one instant.
    """
    same = np.diff(stamps) == 0
    one_instant = np.concatenate([[False], same & is_scan[1:] & ~is_scan[:-1]])
    if 2 * np.sum(same & ~one_instant[1:]) < np.sum(~one_instant):
        return stamps
    spread = stamps.copy()
    starts = np.concatenate([[0], np.flatnonzero(~same) + 1, [len(stamps)]])
    for start, end in itertools.pairwise(starts.tolist()):
        instant = np.cumsum(~one_instant[start:end]) - 1
        gap_ns = stamps[end] - stamps[start] if end < len(stamps) else -1
        step_ns = int(ROUNDED_STEP_S * 1e9)
        if gap_ns > 0:
            step_ns = min(step_ns, int(gap_ns) // (int(instant[-1]) + 1))
        spread[start:end] += np.maximum(instant, 0) * step_ns
    return spread


def mount_profile(log: Path, lines: list[Line]) -> str | None:
    """The profile's TOML that tells the laser's mount, of the lines that tell it; None where none does.

    Raises:
        BadInputError: the laser moves about on the base by more than a centimetre.
    """
    told = [line for line in lines if line.laser is not None]
    if not told:
        return None
    mounts = np.array([relative(line.odometry, line.laser) for line in told if line.laser is not None])
    mount = np.median(mounts, axis=0)
    astray = np.flatnonzero(np.abs(mounts - mount).max(axis=1) > 0.01)
    if len(astray):
        raise BadInputError(f"{log}, line {told[astray[0]].number}: L: the laser sits elsewhere than on most lines")
    x_m, y_m, yaw_deg = np.round([mount[0], mount[1], np.degrees(mount[2])], 3) + 0.0  # + 0.0: no minus zero
    return (
        'schema = 1\nname = "carmen"\n\n[lasers.primary]\n'
        f"mount = {{ x_m = {x_m:.3f}, y_m = {y_m:.3f}, yaw_deg = {yaw_deg:.3f} }}\n"
    )


def to_scan(ranges_m: Array, stamp_ns: int) -> object:
    """A LaserScan of (n,) ranges; the logs do not tell how long the sweep took, so it takes no time."""
    beams = len(ranges_m)
    step = np.radians(STEP_DEG[beams])
    return LaserScan(
        header=header(stamp_ns, "laser_primary"),
        angle_min=-np.pi / 2,
        angle_max=-np.pi / 2 + (beams - 1) * step,
        angle_increment=step,
        time_increment=0.0,
        scan_time=0.0,
        range_min=0.0,
        range_max=NO_RETURN_M,
        ranges=ranges_m.astype(np.float32),
        intensities=np.zeros(0, dtype=np.float32),
    )


def to_odometry(line: Line, stamp_ns: int) -> object:
    """An Odometry of the line's pose; covariances and speeds stay zero, for the logs do not tell them."""
    types = typestore.types
    vector, x_y_theta = types["geometry_msgs/msg/Vector3"], line.odometry
    none, zeros = vector(x=0.0, y=0.0, z=0.0), np.zeros(36)
    pose = types["geometry_msgs/msg/Pose"](
        position=types["geometry_msgs/msg/Point"](x=float(x_y_theta[0]), y=float(x_y_theta[1]), z=0.0),
        orientation=types["geometry_msgs/msg/Quaternion"](
            x=0.0, y=0.0, z=float(np.sin(x_y_theta[2] / 2)), w=float(np.cos(x_y_theta[2] / 2))
        ),
    )
    twist = types["geometry_msgs/msg/Twist"](linear=none, angular=none)
    return Odometry(
        header=header(stamp_ns, "odom"),
        child_frame_id="base_link",
        pose=types["geometry_msgs/msg/PoseWithCovariance"](pose=pose, covariance=zeros),
        twist=types["geometry_msgs/msg/TwistWithCovariance"](twist=twist, covariance=zeros),
    )
