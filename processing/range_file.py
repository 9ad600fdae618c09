"""The ranges of a run in a scratch file, so that a drive of any length takes no memory.

In: scans one after the other, as they are read. Out: `Ranges`, rows of which are read back as arrays when a stage
needs them. It is small itself, and goes to other processes as it is.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hw_profiles.errors import RTLogError

Ints = NDArray[np.int64]
Rows = NDArray[np.float32]

AT_ONCE = 500  # rows that are copied together


@dataclass(frozen=True, slots=True)
class Ranges:
    """n scans of B beams [m]; +inf no return, NaN invalid."""

    path: Path
    shape: tuple[int, int]  # (n, B)
    first: int = 0  # row of the file
    is_mirrored: bool = False  # the file holds the last beam first
    left_out: tuple[tuple[int, int], ...] = ()  # beams, from one to before another, that are given back as NaN

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, which: int | slice | Ints) -> Rows:
        """Rows (k, B), or one (B,). Rows that follow each other are read in one go.

        Raises: RTLogError: the file is shorter than it was, or gone.
        """
        rows = np.arange(len(self))[which]
        wanted = np.atleast_1d(rows)
        breaks = np.flatnonzero(np.diff(wanted) != 1) + 1
        found = np.empty((len(wanted), self.shape[1]), np.float32)
        try:
            with self.path.open("rb") as file:
                for start, end in zip([0, *breaks], [*breaks, len(wanted)], strict=True):
                    if start < end:
                        file.seek((self.first + int(wanted[start])) * found.itemsize * self.shape[1])
                        part = found[start:end]
                        if file.readinto(part.data) != part.nbytes:
                            raise RTLogError(f"{self.path}: was cut short while it was in use")
        except OSError as error:
            raise RTLogError(f"{self.path}: was lost while it was in use: {error.strerror or error}") from error
        found = found[:, ::-1] if self.is_mirrored else found
        for start, end in self.left_out:
            found[:, start:end] = np.nan
        return found if np.ndim(rows) else found[0]

    def mirrored(self) -> "Ranges":
        """With the last beam first."""
        return replace(self, is_mirrored=not self.is_mirrored)

    def cut(self, first: int, last: int) -> "Ranges":
        """Rows `first` to `last`, the last included."""
        return replace(self, shape=(last + 1 - first, self.shape[1]), first=self.first + first)


class RangeFile:
    """Writes the file. Scans shorter than the longest are padded with NaN."""

    def __init__(self, path: Path) -> None:
        """Raises: RTLogError: there is no room, or the folder is gone."""
        self.path, self.rows, self.beams = path, 0, 0
        try:
            self._file = path.open("w+b")
        except OSError as error:
            raise self._no_room(error) from error

    def append(self, ranges: Rows) -> None:
        """Append a scan (b,), or several (k, b). Raises: RTLogError: the disk is full."""
        ranges = np.atleast_2d(ranges)
        rows, beams = ranges.shape
        if not self.rows:
            self.beams = beams
        try:
            if beams > self.beams:
                self._widen(beams)
            elif beams < self.beams:
                ranges = np.hstack([ranges, np.full((rows, self.beams - beams), np.nan, np.float32)])
            self._file.write(np.ascontiguousarray(ranges, np.float32).data)
        except OSError as error:
            raise self._no_room(error) from error
        self.rows += rows

    def _widen(self, beams: int) -> None:
        """Rare, so not in pieces: a scan is longer than all before it."""
        wide = np.full((self.rows, beams), np.nan, np.float32)
        self._file.seek(0)
        wide[:, : self.beams] = np.frombuffer(self._file.read(), np.float32).reshape(self.rows, self.beams)
        self._file.seek(0)
        self._file.write(wide.tobytes())
        self.beams = beams

    def finish(self) -> Ranges:
        """What was written, ready to be read. Raises: RTLogError: the disk is full."""
        try:
            self._file.flush()
        except OSError as error:
            raise self._no_room(error) from error
        return Ranges(self.path, (self.rows, self.beams))

    def _no_room(self, error: OSError) -> RTLogError:
        return RTLogError(f"{self.path}: the scans cannot be kept here: {error.strerror or error}; set TMPDIR")

    def close(self) -> None:
        """Raises: RTLogError: the disk is full, and what is left cannot be written either."""
        try:
            self._file.close()
        except OSError as error:
            raise self._no_room(error) from error


def join_ranges(parts: Sequence[Ranges], path: Path) -> Ranges:
    """Move all into one file. Raises: RTLogError: the disk is full."""
    file = RangeFile(path)
    try:
        for part in parts:
            for first in range(0, len(part), AT_ONCE):
                file.append(part[first : first + AT_ONCE])
            part.path.unlink()
        return file.finish()
    finally:
        file.close()
