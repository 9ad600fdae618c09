"""Searching for a match where the guess is poor, and judging which of several matches is the right one.

In: two scans and a guess. Out: a `ScanMatch`. A match can converge anywhere in a drift; what tells the right place is
that nearly all that both scans must see agrees, not how much of it there is.
"""

import math

import numpy as np
from numpy.typing import NDArray

from processing.scan_match import ScanMatch
from processing.scan_matching import CLOSEST_M, approach, match_scans
from processing.scan_walls import Scan

Array = NDArray[np.float64]

REACH_M, SEARCH_TURN_RAD = 1.0, 0.15  # how far apart the starts of a search lie
APPROACHES = ((REACH_M, 3), (CLOSEST_M, 2))  # reach and steps after which the better half of the starts goes on
SAME_PLACE = (0.05, 0.05, 0.01)  # m, m, rad: matches that have come as close to each other end at one place
AS_GOOD = 0.02  # two scores this close tell nothing apart
POOR_RESIDUAL_M = 0.025  # points this far off the walls they were drawn to say nothing; right matches leave half of it


def search_match(reference: Scan, current: Scan, guess: Array, radius_m: float, radius_rad: float) -> ScanMatch:
    """The best match from starts spread over a radius around the guess: for guesses too poor for `match_scans` alone.

    Best is what `score` says; of matches that are as good, the one nearest to the guess: along a smooth drift all are.
    """
    shifts = np.arange(-np.ceil(radius_m / REACH_M), np.ceil(radius_m / REACH_M) + 1) * REACH_M
    turns = np.linspace(-radius_rad, radius_rad, 2 * int(np.ceil(radius_rad / SEARCH_TURN_RAD)) + 1)
    dx, dy, turn = (axis.ravel() for axis in np.meshgrid(shifts, shifts, turns, indexing="ij"))
    away = np.hypot(dx, dy)
    order = np.lexsort((np.abs(turn), away))
    starts = guess + np.column_stack([dx, dy, turn])[order[away[order] <= radius_m + 1e-9]]
    best = match_scans(reference, current, guess, REACH_M)
    for reach_m, steps in APPROACHES:
        starts = _better_half([approach(reference, current, start, reach_m, steps) for start in starts])
    for start in starts:
        found = match_scans(reference, current, start, CLOSEST_M)
        if score(found) > score(best) + AS_GOOD:
            best = found
    return best


def _better_half(approached: list[ScanMatch]) -> Array:
    """Where to go on from (k, 3), each place once, in the order given: where the scans agree best so far."""
    motions = np.array([match.motion for match in approached])
    apart = np.abs(motions[:, None] - motions[None])
    first = np.argmax(np.all(apart <= SAME_PLACE, axis=-1), axis=1) == np.arange(len(motions))
    worth = [agreement(match) if alone else -math.inf for match, alone in zip(approached, first, strict=True)]
    most = min((len(motions) + 1) // 2, int(first.sum()))
    return np.asarray(motions[np.sort(np.argsort(worth, kind="stable")[::-1][:most])])


def score(match: ScanMatch) -> float:
    """How good a match is: how well the scans agree, if it converged."""
    return agreement(match) if match.converged else -math.inf


def agreement(match: ScanMatch) -> float:
    """What both scans see speaks for a pose; against it speaks, four times as much, what one should have seen and did
    not, and points that lie less closely on the walls than noise and roughness let them.
    """
    if match.inliers == 0:
        return -math.inf
    missing = 1 / match.inliers - 1
    return match.overlap * (1 - 4 * missing - (match.residual_m / POOR_RESIDUAL_M) ** 2)
