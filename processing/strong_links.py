"""Strong links: which pairs of poses that are not neighbours saw the same walls, and what their scans say (paper, 2.1).

In: key frames with their scans and the poses so far. Out: links. Two kinds of pairs are tried:

    hops     ●──●──●──●──●      along one drive, over 2, 4 and 8 m: they stiffen the chain
             └─────┴─────┘
    loops    ●──●──●──●──●      between drives, or a drive and its own past, within Δr_max of each other, in either
               └──┐ └┐          direction: a 270° scanner sees 180° in common when a drift is driven both ways
              ●──●──●──●
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from processing.chain_step import to_laser, to_vehicle
from processing.geometry import compose, relative
from processing.pose_graph import Links
from processing.scan_match import ScanMatch
from processing.scan_matching import Matcher
from processing.scan_walls import Scan

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

HOPS_M = (2.0, 4.0, 8.0)
HOP_INLIERS = 0.6
LOOP_RADIUS_M = 2.5  # Δr_max
LOOP_SPACING_M = 15.0  # a drive meets its own past only after so many metres
LOOP_INLIERS = 0.6
MOST_LOOPS = 4  # of one key frame: where a drift was driven forty times, more would tell nothing new
FIRST_DRIVES = 6  # which those after them are linked to rather than to each other: so each costs as much as the last
UNSEEN_M = 1.0  # a motion known no better than this was not seen
TILT_M, TILT_RAD = 0.02, 0.02
MAX_SIGMA_M = 0.5  # a link that knows no better is not worth having
NEARER = 0.1  # m of view that a metre nearer to the place is worth
VIEW_M = 2.0  # so far before the scanner is the middle of what it sees of a drift


@dataclass(frozen=True, slots=True)
class KeyFrames:
    """N key frames of one or more drives over the same ground."""

    scans: list[Scan]
    drive: Ints  # (N,) which drive each belongs to
    travelled: Array  # (N,) m since the start of its drive
    mounts: Array  # (N, 3) scanner in the vehicle
    match: Matcher


def hop_pairs(frames: KeyFrames, drives: Iterable[int]) -> Ints:
    """Pairs (p, 2) along each of these drives, one for each of HOPS_M and key frame."""
    pairs = [np.empty((0, 2), np.int64)]
    for drive in drives:
        members = np.flatnonzero(frames.drive == drive)
        way = frames.travelled[members]
        for hop in HOPS_M:
            ends = np.searchsorted(way, way + hop)
            valid = (ends < len(members)) & (ends > np.arange(len(members)) + 1)
            pairs.append(np.column_stack([members[valid], members[np.minimum(ends, len(members) - 1)[valid]]]))
    return np.unique(np.concatenate(pairs), axis=0)


def viewpoints(poses: Array, mounts: Array) -> Array:
    """What key frames look at (n, 2): VIEW_M before their scanners at `mounts`, (3,) or (n, 3).

    Those that drove the same way see the same walls where they stand side by side, those that drove opposite ways where
    their scanners face each other.
    """
    return np.asarray(compose(compose(poses, mounts), np.array([VIEW_M, 0.0, 0.0]))[:, :2])


def facing(one: Array, i: int, other: Array, k: int, mounts: tuple[Array, Array]) -> tuple[int, int]:
    """The key frames of two drives near i and k that look at the same walls; poses (n, 3) and (m, 3) in one frame, and
    the mounts of their scanners.
    """
    near_i, near_k = _neighbours(one, i), _neighbours(other, k)
    first, second = viewpoints(one[near_i], mounts[0]), viewpoints(other[near_k], mounts[1])
    apart = np.hypot(*np.moveaxis(first[:, None] - second[None], -1, 0))
    away = np.hypot(*(one[near_i] - one[i])[:, :2].T)[:, None] + np.hypot(*(other[near_k] - other[k])[:, :2].T)
    best = np.unravel_index(int(np.argmin(apart + NEARER * away)), apart.shape)
    return int(near_i[best[0]]), int(near_k[best[1]])


def _neighbours(poses: Array, i: int) -> Ints:
    """Of a drive (n, 3), the key frames in a row around one that lie within sight of it."""
    beyond = np.hypot(*(poses - poses[i])[:, :2].T) > 2 * VIEW_M + 1.0
    before, after = np.flatnonzero(beyond[:i]), np.flatnonzero(beyond[i:])
    first = int(before[-1]) + 1 if len(before) else 0
    last = i + int(after[0]) if len(after) else len(poses)
    return np.arange(first, last)


def loop_pairs(frames: KeyFrames, poses: Array, new: Ints, old: Ints, radius_m: float) -> Ints:
    """Pairs (p, 2) of a new key frame and the old one with the nearest view on every stretch of drive within the
    radius; of many, on MOST_LOOPS: the nearest of FIRST_DRIVES, then the nearest of all others.
    """
    if len(old) == 0 or len(new) == 0:
        return np.empty((0, 2), np.int64)
    views = viewpoints(poses, frames.mounts)
    tree = cKDTree(views[old])
    pairs = []
    for i, near in zip(new, tree.query_ball_point(views[new], radius_m), strict=True):
        candidates = old[np.array(sorted(near), np.int64)]
        same = frames.drive[candidates] == frames.drive[i]
        apart = np.abs(frames.travelled[candidates] - frames.travelled[i]) > LOOP_SPACING_M
        candidates = candidates[(~same | apart) & (candidates != i)]
        if len(candidates) == 0:
            continue
        breaks = (np.diff(candidates) > 3) | (np.diff(frames.drive[candidates]) != 0)
        stretch = np.append(0, np.cumsum(breaks))
        away = np.hypot(*(views[candidates] - views[i]).T)
        best = np.lexsort((away, stretch))[np.append(0, np.flatnonzero(breaks) + 1)]  # of each stretch the nearest
        later = frames.drive[candidates[best]] >= FIRST_DRIVES
        best = np.sort(best[np.lexsort((away[best], later))[:MOST_LOOPS]])
        pairs += [(k, i) for k in candidates[best].tolist()]
    return np.array(pairs, np.int64).reshape(-1, 2)


def blur(covariance: Array) -> Array:
    """The covariance (3, 3) of a match, and where it does not see the way along a drift, doubt about which way that is.

    The direction that a match leaves open comes from noisy walls, and is off by milliradians. Over the metres that two
    drives may be off along a smooth drift, that pretends to see them, and many such links would add up to a lie.
    """
    if extreme_variances(covariance)[1] < UNSEEN_M**2:
        return covariance
    return covariance + np.diag([TILT_M**2, TILT_M**2, TILT_RAD**2])


def match_vehicles(
    reference: Scan,
    current: Scan,
    guess: Array,
    match: Matcher,
) -> ScanMatch:
    """Match two scans; guess and result are motions of the vehicle, or from one vehicle to another."""
    found = match(reference, current, to_laser(reference.mount, current.mount, guess))
    motion, covariance = to_vehicle(reference.mount, current.mount, found.motion, found.covariance)
    return replace(found, motion=motion, covariance=covariance)


def extreme_variances(covariance: Array) -> tuple[float, float]:
    """Of the position, in the direction that is known best and in the one that is known worst: the eigenvalues of the
    upper left (2, 2) of a covariance (3, 3).
    """
    (xx, xy, _), (_, yy, _), _ = covariance.tolist()
    middle, root = (xx + yy) / 2, math.hypot((xx - yy) / 2, xy)
    return middle - root, middle + root


def worth_a_link(found: ScanMatch, min_inliers: float) -> bool:
    """Do the scans match well, and say something?"""
    seen = extreme_variances(found.covariance)[0] < MAX_SIGMA_M**2
    return bool(found.converged and found.inliers >= min_inliers and seen)


def match_pairs(frames: KeyFrames, poses: Array, pairs: Ints, min_inliers: float, between_drives: bool) -> Links:
    """The links that come of the pairs (p, 2): those whose scans match well and say something."""
    ends, motions, covariances = [], [], []
    guesses = relative(poses[pairs[:, 0]], poses[pairs[:, 1]])
    for (i, j), guess in zip(pairs.tolist(), guesses, strict=True):
        found = match_vehicles(frames.scans[i], frames.scans[j], guess, frames.match)
        if worth_a_link(found, min_inliers):
            ends.append((i, j))
            motions.append(found.motion)
            covariances.append(blur(found.covariance) if between_drives else found.covariance)
    informations = np.asarray(np.linalg.inv(np.array(covariances).reshape(-1, 3, 3)))
    return Links.of(np.array(ends, np.int64), np.array(motions), informations, robust=True)
