"""Parts of the map that no run joins, laid together by the tags that they share, all at once.

In: the key frames of every run, each in the frame of its part; which of them are passes of which tag. Out: links
between passes, and every part moved to where they put it. Two shared tags say how two parts lie to each other, to
metres and to which way they face; scans then say the rest, as far as the walls do. One tag alone says where, and which
way only if the walls around it fit one way and not the other.

    part 1   ──A──────────B────C──        the more tags two parts share, the earlier they are joined
    part 2        ──B────C──────D──       parts that were joined share more tags with the others
"""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from processing.edge_map import TAG_M
from processing.geometry import align, compose, inverse, relative, wrap_angle
from processing.pose_graph import NO_LINKS, Links
from processing.registration import QUARTERS, Passing, is_open, pass_hypotheses, register_passes
from processing.scan_match import ScanMatch
from processing.scan_walls import Scan
from processing.stretches import Stretch, contradiction, stretch_of, stretch_rows
from processing.strong_links import blur

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

FAR_ENOUGH_M = 15.0  # tags nearer to each other than that do not say which way a part faces
WITNESSES = 4  # shared tags at which the scans are asked, too
MOST_TRIES = 6  # pairs of passes of one tag: what half a dozen do not tell, the others do not either
ALONG_M, ALONG_STEP_M = 8.0, 0.25  # how far along a drift a tag may be read from elsewhere
CLEARLY_FEWER, MOST = 0.8, 3.0  # scans that contradict: by how many less for the right of two ways, and at most
BLUNT_M = 2.0  # two places along a drift this far apart
ACROSS_M, ACROSS_RAD = 0.3, 0.03  # how well fitting stretches are known across and in heading
TAG_ALONE = np.diag([TAG_M**-2, TAG_M**-2, 1e-4])  # a tag says where, and nothing of the heading


@dataclass(frozen=True, slots=True)
class TagPass:
    """A pass of a tag: a variable of the assembly, and a key frame of a drive."""

    variable: int
    node: int
    drive: int
    index: int
    reach_m: float


@dataclass(frozen=True, slots=True)
class PlacedDrive:
    """The key frames of a run, all in the frame of its part."""

    poses: Array  # (K, 3)
    scans: Sequence[Scan]  # K
    mount: Array  # (3,)
    part: int

    def passing(self, of: TagPass) -> Passing:
        return Passing(self.poses, self.scans, self.mount, of.index, of.reach_m)

    def stretch(self, of: TagPass) -> Stretch:
        rows = stretch_rows(self.poses, of.index)
        return stretch_of(self.poses[rows], [self.scans[k] for k in rows], self.poses[of.index])


@dataclass(frozen=True, slots=True)
class Join:
    """How the second of two parts lies in the frame of the first, and the links that say so."""

    parts: tuple[int, int]
    move: Array  # (3,)
    links: Links
    nodes: list[int]  # the tags that it rests on


def tag_links(passes: Sequence[TagPass], part: Ints, pieces: Sequence[Ints]) -> Links:
    """All passes of a tag in one part (V,) lie where the first of them lies, as far as a tag says; but those that a
    piece, of these variables each, holds together by its scans.
    """
    held: dict[int, set[int]] = defaultdict(set)
    for p, variables in enumerate(pieces):
        for v in variables.tolist():
            held[v].add(p)
    ends, before = [], defaultdict[tuple[int, int], list[int]](list)
    for of in passes:
        others = before[of.node, int(part[of.variable])]
        if others and not any(held[of.variable] & held[other] for other in others):
            ends.append((others[0], of.variable))
        others.append(of.variable)
    informations = np.tile(TAG_ALONE, (len(ends), 1, 1))
    return Links.of(np.array(ends), np.zeros((len(ends), 3)), informations, robust=False)


def join_parts(drives: Sequence[PlacedDrive], passes: Sequence[TagPass]) -> list[Join]:
    """Join parts as long as there are two that share a tag and lie to each other in one way only; in that order."""
    drives, joins, refused = list(drives), list[Join](), set[tuple[int, int]]()
    while True:
        shared = _shared_nodes(drives, passes)
        ranked = sorted((pair for pair in shared if pair not in refused), key=lambda pair: (-len(shared[pair]), pair))
        if not ranked:
            return joins
        a, b = ranked[0]
        found = _join(drives, [of for of in passes if of.node in shared[a, b]], (a, b))
        if found is None:
            refused.add((a, b))
            continue
        joins.append(found)
        refused = {pair for pair in refused if a not in pair and b not in pair}  # they share more tags now
        drives = [replace(of, poses=compose(found.move, of.poses), part=a) if of.part == b else of for of in drives]


def _shared_nodes(drives: list[PlacedDrive], passes: Sequence[TagPass]) -> dict[tuple[int, int], set[int]]:
    nodes: dict[int, set[int]] = {of.part: set() for of in drives}
    for of in passes:
        nodes[drives[of.drive].part].add(of.node)
    return {(a, b): both for a, b in combinations(sorted(nodes), 2) if (both := nodes[a] & nodes[b])}


def _join(drives: list[PlacedDrive], passes: Sequence[TagPass], parts: tuple[int, int]) -> Join | None:
    """By passes of tags that both parts share."""
    ours = [of for of in passes if drives[of.drive].part == parts[0]]
    theirs = [of for of in passes if drives[of.drive].part == parts[1]]
    nodes = sorted({of.node for of in ours})
    places = [np.array([_middle(drives, side, node) for node in nodes]) for side in (ours, theirs)]
    spread_m = min(float(np.hypot(*(at - at.mean(axis=0)).T).max()) for at in places)
    if spread_m < FAR_ENOUGH_M / 2:
        return _join_by_one(drives, ours, theirs, parts)
    move = align(places[1], places[0])
    first = {one.node: one for one in reversed(ours)}
    links, seen = _links_of_tags([(first[other.node], other) for other in theirs]), []  # a part's own hang together
    pairs = [(one, other) for one in ours for other in theirs if one.node == other.node]
    for one, other in _some(pairs, WITNESSES):
        at, there = drives[one.drive].passing(one), drives[other.drive].passing(other)
        heading = float(relative(at.pose, compose(move, there.pose))[2])
        seen += [(one, other, match) for _, match in pass_hypotheses(at, there, (heading,))[:1]]
    return Join(parts, move, links + _links_of_scans(seen), nodes)


def _some(pairs: list[tuple[TagPass, TagPass]], most: int) -> list[tuple[TagPass, TagPass]]:
    """From first to last; no even stride, for that may meet the same pass of theirs each time."""
    return [pairs[k] for k in np.linspace(0, len(pairs) - 1, min(most, len(pairs))).round().astype(int)]


def _middle(drives: list[PlacedDrive], passes: Sequence[TagPass], node: int) -> Array:
    """Where the passes of a tag lie on average."""
    return np.mean([drives[of.drive].poses[of.index, :2] for of in passes if of.node == node], axis=0)


def _links_of_tags(pairs: Sequence[tuple[TagPass, TagPass]]) -> Links:
    ends = np.array([(one.variable, other.variable) for one, other in pairs])
    return Links.of(ends, np.zeros((len(pairs), 3)), np.tile(TAG_ALONE, (len(pairs), 1, 1)), robust=False)


def _links_of_scans(seen: Sequence[tuple[TagPass, TagPass, ScanMatch]]) -> Links:
    if not seen:
        return NO_LINKS
    ends = np.array([(one.variable, other.variable) for one, other, _ in seen])
    informations = np.array([np.linalg.inv(blur(match.covariance)) for _, _, match in seen])
    return Links.of(ends, np.array([match.motion for _, _, match in seen]), informations, robust=True)


def _join_by_one(
    drives: list[PlacedDrive], ours: Sequence[TagPass], theirs: Sequence[TagPass], parts: tuple[int, int]
) -> Join | None:
    """By one tag, or by tags too near to each other to say which way a part faces."""
    stretch = cache(lambda of: drives[of.drive].stretch(of))
    pairs = [(one, other) for one in ours for other in theirs if one.node == other.node]
    for one, other in _some(pairs, MOST_TRIES):
        at, there = drives[one.drive].passing(one), drives[other.drive].passing(other)
        clear = register_passes(at, there)
        if clear is not None:
            links = _links_of_scans([(one, other, clear)]) + _links_of_tags([(one, other)])
            return Join(parts, compose(compose(at.pose, clear.motion), inverse(there.pose)), links, [one.node])
        found = _by_stretches(stretch(one), stretch(other), at, there)
        if found is not None:
            motion, covariance = found
            ends = np.array([(one.variable, other.variable)])
            link = Links.of(ends, motion[None], np.asarray(np.linalg.inv(covariance))[None], robust=False)
            return Join(parts, compose(compose(at.pose, motion), inverse(there.pose)), link, [one.node])
    return None


def _by_stretches(one: Stretch, other: Stretch, at: Passing, there: Passing) -> tuple[Array, Array] | None:
    """The motion (3,) from one pass to another by all that was seen around them, and its covariance (3, 3)."""
    shifts = np.arange(-ALONG_M, ALONG_M + 1e-9, ALONG_STEP_M)
    ways = []
    for _, match in pass_hypotheses(at, there, QUARTERS):
        tried = [match.motion + np.array([shift, 0.0, 0.0]) for shift in (shifts if is_open(match) else np.zeros(1))]
        against = np.array([contradiction(one, other, motion) for motion in tried])
        ways.append((float(against.min()), tried[int(np.argmin(against))], against))
    ways.sort(key=lambda way: way[0])
    if not ways or ways[0][0] > MOST:
        return None
    least, motion, against = ways[0]
    others = [way[0] for way in ways[1:] if abs(wrap_angle(way[1][2] - motion[2])) > 0.5]
    if not others or min(others) - least < max(CLEARLY_FEWER, least):
        return None
    blunt = against[np.abs(np.arange(len(against)) - int(np.argmin(against))) * ALONG_STEP_M >= BLUNT_M]
    along_m = ALONG_STEP_M if len(blunt) == 0 or blunt.min() - least > CLEARLY_FEWER else TAG_M
    return motion, np.diag(np.array([along_m, ACROSS_M, ACROSS_RAD]) ** 2)
