"""Errors that links share: what the wheels of a run still count wrongly once calibrated, they count wrongly everywhere.

In: the links of a piece, and how sure the calibration of each run is. Out: how far each link's motion moves when the
scale of its run is wrong by one standard deviation. Links count as independent when they are solved, and a thousand of
them average a common error away that does not average away; `marginal_covariances` adds it again (Schmidt's consider
filter: Jazwinski 1970, section 8.4).
"""

import numpy as np
from numpy.typing import NDArray

from processing.chain import GATE
from processing.edge_map import PieceMap

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


def scale_errors(piece: PieceMap, runs: Ints, sigmas: Array) -> Array:
    """Changes (q, m, 3) of the motions of m links, one row for each of the q runs in the piece.

    Args:
        piece: Of its P paths. Of the links in a row, the fused ones are robust and those of the wheels are not.
        runs: (P,) which run each path belongs to.
        sigmas: (P,) standard deviation of the scale of its distances.
    """
    links, count = piece.links, int(piece.firsts[-1])
    path = np.searchsorted(piece.firsts, links.ends[:, 0], side="right") - 1
    wheels = np.flatnonzero(piece.in_a_row & ~links.robust)
    fused = np.flatnonzero(piece.in_a_row & links.robust)
    driven = np.zeros((count, 3))  # by the wheels, from each pose to the next
    doubt = np.full(count, np.inf)  # m², along
    driven[links.ends[wheels, 0], :2] = links.motions[wheels, :2]
    doubt[links.ends[wheels, 0]] = np.linalg.inv(links.informations[wheels])[:, 0, 0] / GATE
    share = np.zeros(len(links))  # of the wheels in a motion: all of it where the match saw nothing along
    share[wheels] = 1.0
    left = np.linalg.inv(links.informations[fused])[:, 0, 0]
    share[fused] = np.minimum(left / doubt[links.ends[fused, 0]], 1.0)
    moved = (share * sigmas[path])[:, None] * driven[links.ends[:, 0]]
    return np.stack([np.where((runs[path] == run)[:, None], moved, 0.0) for run in np.unique(runs)])
