"""Sweeps: the scans of a run as the other stages use them, made when they are asked for.

In: ranges, and how the vehicle moved. Out: points of a sweep as if all its beams had been measured at its first ray, or
a `Scan` ready for matching. Law: only the ranges are kept; what can be computed from them in 0.1 ms is not.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import overload

import numpy as np
from numba import njit
from numpy.typing import NDArray

from processing.odometry import MAX_M_S, MAX_RAD_S, Motions
from processing.range_file import Ranges
from processing.read_scans import Scans
from processing.scan_walls import RANGE_NOISE_M, Scan, prepare_scan

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Points = NDArray[np.float32]

AT_ONCE = 64  # scans straightened together


@dataclass(frozen=True, slots=True)
class Sweeps:
    """n sweeps of B beams."""

    ranges: NDArray[np.float32] | Ranges  # (n, B) m; +inf no return, NaN invalid
    times: Array  # (n,) s, of the first ray
    velocities: Array  # (n, 3) of the vehicle at each sweep: ahead, left [m/s], turn [rad/s]
    mount: Array  # (3,) scanner in the vehicle
    angle_min: float
    angle_increment: float
    time_increment_s: float  # between two beams
    range_noise_m: float = RANGE_NOISE_M

    def __len__(self) -> int:
        return len(self.velocities)

    @property
    def angles(self) -> Array:
        """(B,) rad."""
        return self.angle_min + self.angle_increment * np.arange(self.ranges.shape[1], dtype=np.float64)

    def points(self, rows: slice | Ints) -> Points:
        """Points (k, B, 2) in the scanner's frame, the motion during the sweep removed; NaN where there is no range.

        While the mirror turns, the vehicle drives on: at 20 km/h and 15 ms a sweep that is 8 cm.
        """
        return self.straighten(self.ranges[rows], rows)

    def straighten(self, ranges: NDArray[np.float32], rows: slice | Ints) -> Points:
        """`points` of rows whose ranges (k, B) were read already."""
        since = self.time_increment_s * np.arange(ranges.shape[1], dtype=np.float64)
        if self.time_increment_s < 0:
            since -= since[-1]
        out = np.empty((*ranges.shape, 2), np.float32)
        _straighten(np.ascontiguousarray(ranges), self.angles, since, self.velocities[rows], self.mount, out)
        return out

    def scan(self, row: int) -> Scan:
        """Ready for matching."""
        return self._prepare(self.points(slice(row, row + 1))[0])

    def scans(self, rows: Ints) -> Iterator[Scan]:
        """The same, of many."""
        for start in range(0, len(rows), AT_ONCE):
            for points in self.points(rows[start : start + AT_ONCE]):
                yield self._prepare(points)

    def _prepare(self, points: Points) -> Scan:
        return prepare_scan(points, self.angle_min, self.angle_increment, self.mount, self.range_noise_m)

    def cut(self, first: int, last: int) -> "Sweeps":
        """Sweeps `first` to `last`, the last included."""
        kept = slice(first, last + 1)
        ranges = self.ranges.cut(first, last) if isinstance(self.ranges, Ranges) else self.ranges[kept]
        return replace(self, ranges=ranges, times=self.times[kept], velocities=self.velocities[kept])


def sweeps_of(scans: Scans, odometry: Motions, mount: Array) -> Sweeps:
    """The sweeps of a run; `odometry` (n - 1) between them."""
    velocities = velocities_of(odometry.deltas, scans.times)
    angles = scans.angle_min, scans.angle_increment
    return Sweeps(scans.ranges, scans.times, velocities, mount, *angles, scans.time_increment_s, scans.range_noise_m)


def velocities_of(motions: Array, times: Array) -> Array:
    """(n, 3) of the vehicle at each of `times` (n,), from the motions (n - 1, 3) between them; in place of what no
    vehicle does, as where a count starts anew, the one before.
    """
    velocities = np.zeros((len(times), 3))
    if len(times) > 1:
        seconds = np.diff(times)
        seconds = np.maximum(seconds, np.median(seconds) / 2)  # times squeezed by a clock set back are no speed
        velocities[:-1] = motions / seconds[:, None]
        velocities[-1] = velocities[-2]
        possible = (np.hypot(velocities[:, 0], velocities[:, 1]) < MAX_M_S) & (np.abs(velocities[:, 2]) < MAX_RAD_S)
        last = np.maximum.accumulate(np.where(possible, np.arange(len(times)), -1))
        velocities = np.where(last[:, None] >= 0, velocities[last], 0.0)
    return velocities


@dataclass(frozen=True, slots=True)
class StoredScans(Sequence[Scan]):
    """Some of the sweeps, as scans ready for matching."""

    sweeps: Sweeps
    rows: Ints  # (K,)

    def __len__(self) -> int:
        return len(self.rows)

    @overload
    def __getitem__(self, which: int) -> Scan: ...
    @overload
    def __getitem__(self, which: slice) -> "StoredScans": ...
    def __getitem__(self, which: int | slice) -> "Scan | StoredScans":
        if isinstance(which, slice):
            return StoredScans(self.sweeps, self.rows[which])
        return self.sweeps.scan(int(self.rows[which]))

    def __iter__(self) -> Iterator[Scan]:
        return self.sweeps.scans(self.rows)

    def alone(self, which: int) -> "StoredScans":
        """One of them, with nothing of the others."""
        row = int(self.rows[which])
        return StoredScans(self.sweeps.cut(row, row), np.zeros(1, np.int64))


@njit(cache=True)
def _straighten(
    ranges: NDArray[np.float32],  # (n, B)
    angles: Array,  # (B,)
    since: Array,  # (B,) s, of each beam since the first ray
    velocities: Array,  # (n, 3)
    mount: Array,  # (3,)
    out: Points,  # (n, B, 2)
) -> None:
    cosines, sines = np.cos(angles), np.sin(angles)
    mx, my = mount[0], mount[1]
    cm, sm = math.cos(mount[2]), math.sin(mount[2])
    for k in range(ranges.shape[0]):
        vx, vy, turn = velocities[k]
        for i in range(ranges.shape[1]):
            r = np.float64(ranges[k, i])
            if not math.isfinite(r):
                out[k, i, 0] = out[k, i, 1] = np.nan
                continue
            x, y, t = r * cosines[i], r * sines[i], since[i]
            if t != 0.0:
                c, s = math.cos(turn * t), math.sin(turn * t)
                # where the scanner is by then, seen from where it was: ⊖mount ⊕ (v t ⊕ mount)
                dx, dy = vx * t + c * mx - s * my - mx, vy * t + s * mx + c * my - my
                x, y = cm * dx + sm * dy + c * x - s * y, -sm * dx + cm * dy + s * x + c * y
            out[k, i, 0], out[k, i, 1] = x, y
