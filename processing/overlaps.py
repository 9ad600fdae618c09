"""Overlaps: pieces that lie over each other without sharing a pass, joined by links between their key frames.

In: solved pieces, and where the assembly has put their frames so far. Out: links, whose ends join the boundary. What
was matched once is not matched again, as long as the assembly confirms it.
"""

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from processing.boundary import Boundary
from processing.geometry import compose, relative, wrap_angle
from processing.known_matches import CONFIRMED
from processing.pieces import SolvedPiece
from processing.pose_graph import Links
from processing.registration import find_near, is_open
from processing.scan_match import ScanMatch
from processing.scan_matching import Matcher
from processing.strong_links import LOOP_INLIERS, blur, match_vehicles, viewpoints, worth_a_link
from processing.sweeps import StoredScans
from processing.workers import Workers

Array = NDArray[np.float64]

OVERLAP_M = 2.5  # key frames of different pieces this close see the same walls
OVERLAP_SPACING_M = 3.0
ALONG_M = 0.3  # along an open direction, from guesses as close a match says the same of the others
SEARCHES = 4  # key frames of an overlap whose match may be metres off


Pair = tuple[str, int, str, int]  # two key frames: of which run, which of it
Known = dict[Pair, tuple[Array, ScanMatch]]  # the guess (3,) that a match began with, and what came of it


@dataclass(frozen=True, slots=True)
class Meeting:
    """A key frame of one piece beside one of another."""

    indices: tuple[int, int]  # in the pieces
    pair: Pair  # the same
    scans: tuple[StoredScans, StoredScans]  # one scan each
    guess: Array  # (3,) the second seen from the first
    known: ScanMatch | None  # that need not be made again


@dataclass(frozen=True, slots=True)
class Overlap:
    """Two pieces that lie over each other, and k places where they meet."""

    numbers: tuple[int, int]  # of the pieces
    meetings: list[Meeting]  # k

    def match(self, match: Matcher) -> list[ScanMatch]:
        """k matches, of the vehicle; where none says in all directions how the pieces lie, some are searched for."""
        found = [of.known or match_vehicles(of.scans[0][0], of.scans[1][0], of.guess, match) for of in self.meetings]
        if not any(worth_a_link(of, LOOP_INLIERS) and not is_open(of) for of in found):
            for n in np.unique(np.linspace(0, len(found) - 1, SEARCHES).round().astype(int)).tolist():
                of = self.meetings[n]
                if of.known is None:
                    found[n] = find_near(of.scans[0][0], of.scans[1][0], of.guess) or found[n]
        return found


def find_overlaps(solved: list[SolvedPiece], frames: list[Array], parts: list[int], known: Known) -> list[Overlap]:
    poses = [compose(frame, piece.map.poses) for frame, piece in zip(frames, solved, strict=True)]
    views = [viewpoints(of, piece.mounts) for of, piece in zip(poses, solved, strict=True)]
    trees = [cKDTree(of) for of in views]
    low = np.array([of.min(axis=0) for of in views]) - OVERLAP_M
    high = np.array([of.max(axis=0) for of in views])
    found = []
    for q in range(len(solved)):
        for p in np.flatnonzero(np.all(low[:q] < high[q], axis=1) & np.all(low[q] < high[:q], axis=1)):
            if parts[p] != parts[q]:
                continue
            distance, near = trees[p].query(views[q], distance_upper_bound=OVERLAP_M)
            last, meetings = np.full(2, np.inf), []
            for k in np.flatnonzero(np.isfinite(distance)).tolist():
                if np.hypot(*(poses[q][k, :2] - last)) < OVERLAP_SPACING_M:
                    continue
                i, last = int(near[k]), poses[q][k, :2]
                pair, guess = (*solved[p].keyframe(i), *solved[q].keyframe(k)), relative(poses[p][i], poses[q][k])
                before = known[pair][1] if pair in known and confirms(guess, *known[pair]) else None
                meetings.append(Meeting((i, k), pair, (solved[p].scan(i), solved[q].scan(k)), guess, before))
            if meetings:
                found.append(Overlap((int(p), q), meetings))
    return found


def confirms(guess: Array, before: Array, found: ScanMatch) -> bool:
    """Would a match from this guess (3,) find the same as from the guess before? Where walls leave a direction open,
    also from elsewhere along it.
    """
    moved, off = guess - before, guess - found.motion
    moved[2], off[2] = wrap_angle(moved[2]), wrap_angle(off[2])
    if not found.converged:
        return bool(np.all(np.abs(moved) < CONFIRMED))
    doubt = found.covariance + np.diag(np.square(CONFIRMED))
    return bool(off @ np.linalg.solve(doubt, off) < 1.0 and np.hypot(*moved[:2]) < ALONG_M)


def link_overlaps(overlaps: list[Overlap], boundary: Boundary, match: Matcher, work: Workers, known: Known) -> Links:
    """Links between the key frames of overlaps, which join the boundary; `known` learns what was matched."""
    ends, motions, informations = [], [], []
    matches = work.map("overlaps", partial(Overlap.match, match=match), overlaps, at_once=10)
    for overlap, found in zip(overlaps, matches, strict=True):
        p, q = overlap.numbers
        for of, seen in zip(overlap.meetings, found, strict=True):
            if of.known is None:
                known[of.pair] = of.guess, seen
            if worth_a_link(seen, LOOP_INLIERS):
                a, b = boundary.add(p, of.indices[0]), boundary.add(q, of.indices[1])
                if a == b:  # the pass that both begin with: nothing between
                    continue
                ends.append((a, b))
                motions.append(seen.motion)
                informations.append(np.linalg.inv(blur(seen.covariance)))
    return Links.of(np.array(ends), np.array(motions), np.array(informations), robust=True)
