"""Laser scans of a recording: LaserScan messages → `Scans`, their ranges in a scratch file.

In: the messages in the order of the recording. Out: ranges as they were measured, beams counter-clockwise.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from hw_profiles.errors import BadInputError
from hw_profiles.profile import Laser
from processing.own_parts import OwnPart, find_own_parts
from processing.range_file import RangeFile, Ranges, join_ranges
from rtlog_server.messages import to_ns

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]

EDGE_DEG = 1e-3  # a beam on the edge of a blind sector, as its angle is rounded, is blind


@dataclass(frozen=True, slots=True)
class Scans:
    """n scans of B beams each in the scanner's frame; shorter scans are padded with NaN."""

    stamps_ns: Stamps  # (n,) of the first ray
    times: Array  # (n,) s, strictly rising
    ranges: NDArray[np.float32] | Ranges  # (n, B) m; +inf no return, NaN invalid
    angle_min: float
    angle_increment: float
    time_increment_s: float  # between two beams of a sweep
    range_noise_m: float = Laser().range_noise_m
    own_parts: tuple[OwnPart, ...] = ()  # beams that saw the vehicle itself; their ranges are NaN

    @property
    def angles(self) -> Array:
        """(B,) rad, counter-clockwise."""
        return self.angle_min + self.angle_increment * np.arange(self.ranges.shape[1], dtype=np.float64)


@dataclass(frozen=True, slots=True)
class ReadScans:
    """What was read of the scans in a stretch of a recording: k of them."""

    stamps_ns: Stamps  # (k,)
    log_times_ns: Stamps  # (k,)
    ranges: Ranges  # (k, B), beams as they were recorded
    settings: dict[tuple[float, float], tuple[float, float, float]]  # angle_min, angle_increment, time_increment


class ScanReader:
    """Takes the scans of a stretch as they come; their ranges go to the file `scratch`."""

    def __init__(self, scratch: Path, laser: Laser) -> None:
        self._laser = laser
        self._file = RangeFile(scratch)
        self._stamps_ns: list[int] = []
        self._log_times_ns: list[int] = []
        self._settings: dict[tuple[float, float], tuple[float, float, float]] = {}

    def add(self, message: Any, log_time_ns: int) -> None:
        ranges = np.array(message.ranges, np.float32)
        if message.range_max > 0:
            ranges[ranges >= message.range_max] = np.inf
        ranges[(ranges <= 0) | (ranges < max(message.range_min, self._laser.min_range_m))] = np.nan
        start, increment = float(message.angle_min), float(message.angle_increment)
        if self._laser.blind_sectors_deg:
            angles = start + increment * np.arange(len(ranges), dtype=np.float64)
            ranges[in_sectors(angles, self._laser.blind_sectors_deg)] = np.nan
        self._file.append(ranges)
        self._stamps_ns.append(to_ns(message.header.stamp))
        self._log_times_ns.append(log_time_ns)
        self._settings[round(increment, 7), round(start, 5)] = start, increment, float(message.time_increment)

    def finish(self) -> ReadScans:
        """All that were added. Raises: RTLogError: the disk is full."""
        stamps_ns, log_times_ns = np.array(self._stamps_ns, np.int64), np.array(self._log_times_ns, np.int64)
        return ReadScans(stamps_ns, log_times_ns, self._file.finish(), self._settings)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, _kind: type[BaseException] | None, _value: BaseException | None, _trace: TracebackType | None
    ) -> None:
        self._file.close()


def in_sectors(angles: Array, sectors_deg: Sequence[tuple[float, float]]) -> NDArray[np.bool_]:
    """Which angles (B,) [rad] lie in one of the sectors [deg], each counter-clockwise from its first to its second."""
    inside = np.zeros(len(angles), np.bool_)
    for start, end in sectors_deg:
        inside |= (np.degrees(angles) - start + EDGE_DEG) % 360 <= (end - start) % 360 + 2 * EDGE_DEG
    return inside


def join_scans(recording: Path, parts: Sequence[ReadScans], laser: Laser, scratch: Path) -> Scans:
    """The scans of all stretches, their ranges in the one file `scratch`; their times are still to be found.

    Raises:
        BadInputError: they do not fit together.
        RTLogError: the disk is full.
    """
    settings = {key: setting for part in parts for key, setting in part.settings.items()}
    if not settings:
        raise BadInputError(f"{recording}: holds none of the scans that its index counts")
    if len(settings) > 1:
        raise BadInputError(
            f"{recording}: the scanner's angles change within the recording; record each setting by itself"
        )
    ((start, increment, time_increment),) = settings.values()
    if not abs(increment) > 1e-5:
        raise BadInputError(f"{recording}: the scans have an angle_increment of zero")
    ranges = join_ranges([part.ranges for part in parts], scratch)
    beams = ranges.shape[1]
    if beams < 10:
        raise BadInputError(f"{recording}: scans of {beams} beams cannot be matched")
    if increment < 0:  # mounted upside down, or a driver that counts clockwise: the first ray is the last beam
        start, increment, time_increment = start + increment * (beams - 1), -increment, -time_increment
        ranges = ranges.mirrored()
    stamps_ns = np.concatenate([part.stamps_ns for part in parts])
    times = np.empty(len(stamps_ns))
    scans = Scans(stamps_ns, times, ranges, start, increment, time_increment, laser.range_noise_m)
    own_parts = find_own_parts(ranges, scans.angles)
    left_out = tuple((part.first, part.end) for part in own_parts)
    return replace(scans, ranges=replace(ranges, left_out=left_out), own_parts=tuple(own_parts))
