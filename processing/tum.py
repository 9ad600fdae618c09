"""Trajectories as text, in the format of the TUM benchmarks: `t x y z qx qy qz qw` a line, t in seconds UTC."""

from decimal import Decimal
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hw_profiles.errors import BadInputError

Array = NDArray[np.float64]


def write_tum(path: Path, stamps_ns: NDArray[np.int64], poses: Array) -> None:
    """Write poses (n, 3) in the plane; stamps to the nanosecond, lengths to the micrometre."""
    half = poses[:, 2] / 2
    with path.open("w", encoding="utf-8") as file:
        for ns, x, y, z, w in zip(stamps_ns, poses[:, 0], poses[:, 1], np.sin(half), np.cos(half), strict=True):
            file.write(f"{ns // 10**9}.{ns % 10**9:09d} {x:.6f} {y:.6f} 0 0 0 {z:.9f} {w:.9f}\n")


def read_tum(path: Path) -> tuple[NDArray[np.int64], Array]:
    """Stamps [ns] and poses (n, 3). Raises: BadInputError: the file cannot be read, or a line is malformed: with its
    number.
    """
    stamps: list[np.int64] = []
    rows: list[list[float]] = []
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except OSError as error:
        raise BadInputError(f"{path}: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise BadInputError(f"{path}: not UTF-8 text (byte {error.start})") from error
    for number, line in enumerate(lines, start=1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        if len(words) != 8:
            raise BadInputError(f"{path}, line {number}: {len(words)} numbers instead of 8")
        try:
            stamps.append(np.int64(int(Decimal(words[0]).scaleb(9))))  # exact, also as 1.4036e+09
            rows.append([float(word) for word in words[1:]])
        except (ValueError, ArithmeticError) as error:
            raise BadInputError(f"{path}, line {number}: not a number among {line.strip()!r}") from error
        if not np.all(np.isfinite(rows[-1])):
            raise BadInputError(f"{path}, line {number}: a pose that is not finite")
    values = np.array(rows).reshape(-1, 7)
    x, y, _, qx, qy, qz, qw = values.T
    heading = np.arctan2(2 * (qw * qz + qx * qy), 1 - 2 * (qy * qy + qz * qz))
    return np.array(stamps, np.int64), np.column_stack([x, y, heading])
