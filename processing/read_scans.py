"""Laser scans of a recording: LaserScan messages → `Scans`, their ranges in a scratch file.

In: the messages in the order of the recording. Out: ranges as they were measured, beams counter-clockwise.
"""

from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from hw_profiles.errors import BadInputError
from processing.range_file import RangeFile, Ranges
from rtlog_server.messages import to_ns

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Scans:
    """n scans of B beams each in the scanner's frame; shorter scans are padded with NaN."""

    stamps_ns: Stamps  # (n,) of the first ray
    times: Array  # (n,) s, strictly rising
    ranges: NDArray[np.float32] | Ranges  # (n, B) m; +inf no return, NaN invalid
    angle_min: float
    angle_increment: float
    time_increment_s: float  # between two beams of a sweep

    @property
    def angles(self) -> Array:
        """(B,) rad, counter-clockwise."""
        return self.angle_min + self.angle_increment * np.arange(self.ranges.shape[1], dtype=np.float64)


class ScanReader:
    """Takes the scans of `recording` as they come; their ranges go to the file `scratch`."""

    def __init__(self, recording: Path, scratch: Path) -> None:
        self._recording = recording
        self._file = RangeFile(scratch)
        self._stamps_ns: list[int] = []
        self._log_times_ns: list[int] = []
        self._settings: set[tuple[float, float]] = set()
        self._last: Any = None

    def add(self, message: Any, log_time_ns: int) -> None:
        ranges = np.array(message.ranges, np.float32)
        if message.range_max > 0:
            ranges[ranges >= message.range_max] = np.inf
        ranges[(ranges <= 0) | (ranges < message.range_min)] = np.nan  # nearer than can be measured
        self._file.append(ranges)
        self._stamps_ns.append(to_ns(message.header.stamp))
        self._log_times_ns.append(log_time_ns)
        self._settings.add((round(float(message.angle_increment), 7), round(float(message.angle_min), 5)))
        self._last = message

    @property
    def stamps_ns(self) -> Stamps:
        return np.array(self._stamps_ns, np.int64)

    def ticks(self, tick_log_times_ns: list[int]) -> Stamps:
        """The tick of each scan, counted from the first of the recording; without ticks its own number."""
        if not tick_log_times_ns:
            return np.arange(len(self._stamps_ns))
        return np.searchsorted(tick_log_times_ns, self._log_times_ns, side="right") - 1

    def scans(self, times: Array, in_memory: bool) -> Scans:
        """All that were added, at these times (n,). Raises: BadInputError: they do not fit together."""
        if len(self._settings) > 1:
            what = "the scanner's angles change within the recording; record each setting by itself"
            raise BadInputError(f"{self._recording}: {what}")
        if not abs(self._last.angle_increment) > 1e-5:
            raise BadInputError(f"{self._recording}: the scans have an angle_increment of zero")
        if self._file.beams < 10:
            raise BadInputError(f"{self._recording}: scans of {self._file.beams} beams cannot be matched")
        start, increment = float(self._last.angle_min), float(self._last.angle_increment)
        time_increment, mirrored = float(self._last.time_increment), increment < 0
        if mirrored:  # a scanner mounted upside down, or a driver that counts clockwise
            start, increment = start + increment * (self._file.beams - 1), -increment
            time_increment = -time_increment  # the first ray is now the last beam
        ranges = self._file.finish(mirrored)
        return Scans(self.stamps_ns, times, ranges[:] if in_memory else ranges, start, increment, time_increment)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, _kind: type[BaseException] | None, _value: BaseException | None, _trace: TracebackType | None
    ) -> None:
        self._file.close()
