"""Matches that were made before: from poses that have hardly moved since, none is made again.

In: pairs of key frames, and the poses so far. Out: the links that their matches are, old and new.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from processing.geometry import relative, wrap_angle
from processing.pose_graph import NO_LINKS, Links, join_links
from processing.strong_links import LOOP_INLIERS, KeyFrames, match_pairs

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

CONFIRMED = (0.03, 0.03, 0.01)  # m, m, rad: from a guess as close to what was found, a match finds the same


@dataclass(frozen=True, slots=True)
class Matches:
    """Of p pairs of key frames, whether their scans match or not."""

    pairs: Ints  # (p, 2) ascending
    motions: Array  # (p, 3) that were found; where none was, the guess
    links: Links  # those that were found

    @staticmethod
    def none() -> "Matches":
        return Matches(np.zeros((0, 2), np.int64), np.zeros((0, 3)), NO_LINKS)

    @staticmethod
    def joined(parts: Sequence["Matches"]) -> "Matches":
        """Those of different pairs, one part at least."""
        pairs = np.concatenate([part.pairs for part in parts])
        order = np.lexsort((pairs[:, 1], pairs[:, 0]))
        motions = np.concatenate([part.motions for part in parts])
        return Matches(pairs[order], motions[order], join_links([part.links for part in parts]))


def match_loops(frames: KeyFrames, poses: Array, pairs: Ints, known: Matches) -> Matches:
    """The matches of these pairs (p, 2), in any order, and of no others; those that are known still hold as long as
    the poses confirm them.
    """
    pairs = np.unique(np.sort(pairs, axis=1), axis=0)
    motions = relative(poses[pairs[:, 0]], poses[pairs[:, 1]])
    where = find_rows(pairs, known.pairs)
    again = where < 0
    moved = motions[~again] - known.motions[where[~again]]
    moved[:, 2] = wrap_angle(moved[:, 2])  # drives both ways lie half a turn apart
    again[~again] = np.any(np.abs(moved) > CONFIRMED, axis=1)
    kept = known.links[find_rows(known.links.ends, pairs[~again]) >= 0]
    found = match_pairs(frames, poses, pairs[again], LOOP_INLIERS, between_drives=True)
    motions[~again] = known.motions[where[~again]]
    motions[find_rows(found.ends, pairs)] = found.motions
    return Matches(pairs, motions, kept + found)


def find_rows(rows: Ints, among: Ints) -> Ints:
    """Where each of the rows (n, 2) stands among others (m, 2), which are sorted; -1: nowhere."""
    if not len(among):
        return np.full(len(rows), -1)
    width = 1 + max(int(among.max()), int(rows.max(initial=0)))
    keys, wanted = among @ [width, 1], rows @ [width, 1]
    at = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
    return np.where(keys[at] == wanted, at, -1)
