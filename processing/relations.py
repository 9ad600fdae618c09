"""Kümmerle's metric: how well a trajectory keeps relative poses that were checked by hand.

In: a trajectory, relations between pairs of its moments, raw odometry. Out: mean and standard deviation of the
translational and the rotational error over all relations. No alignment is needed, for only relative poses are compared.
Source: Kümmerle, Steder, Dornhege, Ruhnke, Grisetti, Stachniss, Kleiner 2009, eq. 4.

A relation names its ends by time. Each takes the estimate nearest to it; where that is further than `NEAR_S` away, the
estimate is carried along by raw odometry from its own moment to the relation's.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hw_profiles.errors import BadInputError
from processing.geometry import Array, compose, relative

NEAR_S = 0.1


@dataclass(frozen=True, slots=True)
class Relations:
    start_ns: NDArray[np.int64]  # (n,) on the recording's clock
    end_ns: NDArray[np.int64]  # (n,)
    poses: Array  # (n, 3) the pose at the end in the frame of that at the start


@dataclass(frozen=True, slots=True)
class RelationErrors:
    relations: int
    carried: int  # ends that raw odometry had to reach
    translation_mean_m: float
    translation_std_m: float
    rotation_mean_deg: float
    rotation_std_deg: float


def read_relations(path: Path) -> Relations:
    """Lines of `t1 t2 x y z roll pitch yaw`, as the Freiburg SLAM benchmark publishes them.

    Raises:
        BadInputError: the file cannot be read, holds no relation, or a line is malformed: with its number.
    """
    rows: list[list[float]] = []
    try:
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
            if not line.strip() or line.startswith("#"):
                continue
            try:
                row = [float(word) for word in line.split()]
            except ValueError as error:
                raise BadInputError(f"{path}, line {number}: {error}") from error
            if len(row) != 8 or not np.isfinite(row).all():
                raise BadInputError(f"{path}, line {number}: no eight finite numbers t1 t2 x y z roll pitch yaw")
            rows.append(row)
    except OSError as error:
        raise BadInputError(f"{path}: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise BadInputError(f"{path}: not a text of relations (byte {error.start})") from error
    if not rows:
        raise BadInputError(f"{path}: holds no relation")
    table = np.array(rows)
    start_ns, end_ns = np.round(table[:, :2] * 1e6).astype(np.int64).T * 1000  # the files give microseconds
    return Relations(start_ns, end_ns, table[:, [2, 3, 7]])


def relation_errors(
    stamps_ns: NDArray[np.int64],  # (n,) of the trajectory, in any order
    poses: Array,  # (n, 3)
    relations: Relations,
    odometry_stamps_ns: NDArray[np.int64],  # (m,) in any order
    odometry: Array,  # (m, 3) raw, in a frame of its own
) -> RelationErrors:
    """The trajectory against the relations.

    Raises:
        BadInputError: the trajectory or the odometry is empty, or no relation lies within their time.
    """
    if not len(stamps_ns) or not len(odometry_stamps_ns):
        raise BadInputError("there is no pose to compare with the relations")
    ends = np.concatenate([relations.start_ns, relations.end_ns])
    first, last = np.min(odometry_stamps_ns), np.max(odometry_stamps_ns)
    if np.all((ends < first - 1_000_000_000) | (ends > last + 1_000_000_000)):
        raise BadInputError("no relation lies within the time of the run: they belong to another recording")
    near = _nearest(stamps_ns, ends)
    estimate = poses[near].astype(np.float64)
    far = np.abs(stamps_ns[near] - ends) > NEAR_S * 1e9
    from_odometry = odometry[_nearest(odometry_stamps_ns, stamps_ns[near[far]])]
    to_odometry = odometry[_nearest(odometry_stamps_ns, ends[far])]
    estimate[far] = compose(estimate[far], relative(from_odometry, to_odometry))
    count = len(relations.poses)
    errors = relative(relations.poses, relative(estimate[:count], estimate[count:]))
    translation, rotation = np.hypot(errors[:, 0], errors[:, 1]), np.degrees(np.abs(errors[:, 2]))
    return RelationErrors(
        relations=count,
        carried=int(np.sum(far)),
        translation_mean_m=float(translation.mean()),
        translation_std_m=float(translation.std()),
        rotation_mean_deg=float(rotation.mean()),
        rotation_std_deg=float(rotation.std()),
    )


def _nearest(stamps_ns: NDArray[np.int64], wanted_ns: NDArray[np.int64]) -> NDArray[np.intp]:
    """For each wanted time the index of the nearest stamp, of equally near ones the first."""
    order = np.argsort(stamps_ns, kind="stable")
    ascending = stamps_ns[order]
    right = np.searchsorted(ascending, wanted_ns).clip(1, max(len(stamps_ns) - 1, 1))
    left = right - 1
    right = right.clip(0, len(stamps_ns) - 1)
    return order[np.where(wanted_ns - ascending[left] <= ascending[right] - wanted_ns, left, right)]
