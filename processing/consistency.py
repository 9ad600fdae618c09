"""Consistency: whether the errors of an atlas are as large as its covariances say.

In: the edges of an atlas on disk, and the truth of their runs. Out: the normalised estimation error squared, NEES
(Bar-Shalom, Li and Kirubarajan 2001, section 5.4): of the far end of an edge as its first drive saw it from the
beginning, and of all poses of that drive. Its mean is the number of dimensions, three, where the covariances tell the
truth: larger, they promise too much; smaller, too little. Edges are taken as independent of each other; the poses of
one edge are not.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from processing.edge_arrays import read_edge_arrays
from processing.evaluation import truth_at
from processing.geometry import Array, relative, rotation, wrap_angle

DIMENSIONS = 3
WITHIN = 0.95


@dataclass(frozen=True, slots=True)
class EdgeError:
    edge: str
    error: Array  # (3,) x [m], y [m], θ [rad] of the last pose, in the frame of the first
    covariance: Array  # (3, 3) as the atlas states it
    nees: float
    pose_nees: float  # mean over all poses of the drive


@dataclass(frozen=True, slots=True)
class Consistency:
    edges: int
    mean_nees: float  # 3 where the covariances are right
    band: tuple[float, float]  # holds the mean of as many edges, were they right, 95 times of 100
    pose_mean_nees: float


def edge_error(name: str, poses: Array, covariances: Array, truth: Array) -> EdgeError | None:
    """The last of the N poses of a drive through an edge, against the truth at the same moments; None of one pose.

    Args:
        name: Of the edge.
        poses: (N, 3) in any frame.
        covariances: (N, 3, 3) of the poses as seen from the first, along the axes of that frame.
        truth: (N, 3) in another frame.
    """
    back = np.eye(DIMENSIONS)
    back[:2, :2] = rotation(-poses[0, 2])
    errors = relative(poses[:1], poses) - relative(truth[:1], truth)
    errors[:, 2] = wrap_angle(errors[:, 2])
    stated = back @ covariances @ back.T
    known = np.linalg.eigvalsh(stated)[:, 0] > 0
    if not known[-1]:
        return None
    nees = np.full(len(poses), np.nan)
    nees[known] = np.einsum("ni,ni->n", errors[known], np.linalg.solve(stated[known], errors[known, :, None])[..., 0])
    return EdgeError(name, errors[-1], stated[-1], float(nees[-1]), float(np.nanmean(nees)))


def edge_errors(
    atlas: Path, edges: list[Mapping[str, Any]], truths: Mapping[str, tuple[NDArray[np.int64], Array]]
) -> list[EdgeError]:
    """The first drive through each edge whose run has a truth: by run id stamps [ns] ascending, and poses (m, 3).

    An edge without a file, as in an atlas that was made elsewhere or thinned out, states nothing that could be judged.

    Raises: BadInputError: the file of an edge is damaged.
    """
    found = []
    for edge in edges:
        file = atlas / "edges" / f"{edge['id']}.npz"
        run = edge["paths"][0]["run"]
        if edge["kind"] != "edge" or run not in truths or not file.exists():
            continue
        arrays = read_edge_arrays(file, ("path_firsts", "poses", "covariances", "stamps_ns"))
        first = slice(0, int(arrays["path_firsts"][1]))
        poses, covariances, stamps_ns = (arrays[key][first] for key in ("poses", "covariances", "stamps_ns"))
        error = edge_error(edge["id"], poses, covariances, truth_at(*truths[run], stamps_ns))
        if error is not None:
            found.append(error)
    return found


def mean_band(count: int) -> tuple[float, float]:
    """Between which bounds the mean of `count` independent NEES lies 95 times of 100."""
    tail = (1 - WITHIN) / 2
    low, high = chdtri(DIMENSIONS * count, [1 - tail, tail]) / count
    return float(low), float(high)


def consistency(errors: list[EdgeError]) -> Consistency | None:
    """Over all edges; None of none."""
    if not errors:
        return None
    mean = float(np.mean([error.nees for error in errors]))
    return Consistency(len(errors), mean, mean_band(len(errors)), float(np.mean([error.pose_nees for error in errors])))
