"""Relocation: where a key frame lies on the map so far, when open loop has strayed too far for a match from there.

In: a scan, a guess and how wrong it may be; key frames with known poses. Out: the best pose of a window around the
guess, by a likelihood field (Olson 2009, correlative scan matching): an image of the known walls, blurred by as much as
one step of the search, in which the points of the scan are looked up and added.
"""

import numpy as np
from numpy.typing import NDArray

from processing.correlative_search import search_window
from processing.geometry import compose, inverse, relative, transform, wrap_angle
from processing.match_search import score
from processing.pose_graph import NO_LINKS, Links
from processing.scan_walls import Scan
from processing.strong_links import KeyFrames, blur, match_vehicles, viewpoints

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

CELL_M = 0.15
MAX_POINTS = 180  # of a scan, evenly chosen: more only make it slower
MAX_RANGE_M = 15.0
TRIES = 8  # key frames of a stretch
NEIGHBOURS = 5  # known key frames that each is matched to
MIN_SHARE = 0.4  # of a scan's points on walls
MIN_SCORE, MIN_TOGETHER = 0.1, 0.8  # of one match, of all that agree
MIN_AGREEING = 0.5  # of those that were tried
AGREE_M, AGREE_RAD = 1.0, 0.15


def likelihood_field(scans: list[Scan], laser_poses: Array) -> tuple[NDArray[np.uint8], Array]:
    """The walls (H, W) seen by key frames: 4 on a wall, less beside it; and the corner (2,) of cell [0, 0]."""
    seen = [transform(pose, _points(scan)) for scan, pose in zip(scans, laser_poses, strict=True)]
    points = np.concatenate([np.zeros((0, 2)), *seen])
    if not len(points):
        return np.zeros((1, 1), np.uint8), np.zeros(2)
    origin = points.min(axis=0) - 2 * CELL_M
    size = np.ceil((points.max(axis=0) - origin) / CELL_M).astype(int) + 2
    field = np.zeros((size[1], size[0]), np.uint8)
    column, row = ((points - origin) / CELL_M).astype(int).T
    for dy, dx, value in [(0, 0, 4)] + [(y, x, 2) for y in (-1, 0, 1) for x in (-1, 0, 1) if (y, x) != (0, 0)]:
        np.maximum.at(field, (row + dy, column + dx), np.uint8(value))
    return field, origin


def _points(scan: Scan) -> Array:
    points = scan.points[np.isfinite(scan.points[:, 0])]
    points = points[np.hypot(*points.T) < MAX_RANGE_M]
    return points[:: max(1, len(points) // MAX_POINTS)]


def relocate(
    scan: Scan, field: NDArray[np.uint8], origin: Array, guess: Array, radius_m: float, radius_rad: float
) -> tuple[Array, float]:
    """The best pose (3,) of the vehicle around `guess`, and the share of the scan's points that lie on walls there."""
    points = _points(scan)
    reach = float(np.hypot(*points.T).max(initial=1.0))
    turns = np.arange(-radius_rad, radius_rad + 1e-9, CELL_M / reach)
    laser = compose(guess, scan.mount)
    start, headings = (laser[:2] - origin) / CELL_M, laser[2] + turns
    (dx, dy, k), value = search_window(field, start, headings, points / CELL_M, radius_m / CELL_M)
    turned = laser + np.array([dx * CELL_M, dy * CELL_M, turns[k]])
    found = compose(turned, inverse(scan.mount))
    return found, value / (4.0 * max(len(points), 1))


def relocate_stretch(
    frames: KeyFrames, poses: Array, stretch: Ints, known: Ints, radius_m: float, radius_rad: float
) -> Links:
    """Links from known key frames to some of a stretch that may lie up to `radius_m` and `radius_rad` off; or none.

    A place is believed when two key frames of the stretch are found apart from each other, and agree on how far the
    stretch is off.
    """
    middle = poses[stretch, :2].mean(axis=0)
    known = known[np.hypot(*(poses[known, :2] - middle).T) < radius_m + MAX_RANGE_M]
    if len(known) < 2 or len(stretch) < 2:
        return NO_LINKS
    field, origin = likelihood_field([frames.scans[k] for k in known], compose(poses[known], frames.mounts[known]))
    ends, motions, informations, shifts, worths = [], [], [], [], []
    tries = stretch[np.unique(np.linspace(0, len(stretch) - 1, TRIES).astype(int))]
    for k in tries:
        place, share = relocate(frames.scans[k], field, origin, poses[k], radius_m, radius_rad)
        if share < MIN_SHARE:
            continue
        off = viewpoints(poses[known], frames.mounts[known]) - viewpoints(place[None], frames.mounts[k])
        order = np.argsort(np.hypot(*off.T), kind="stable")
        tried = []
        for near in known[order[:NEIGHBOURS]]:
            guess = relative(poses[near], place)
            found = match_vehicles(frames.scans[near], frames.scans[k], guess, frames.match)
            tried.append((score(found), int(near), found))
        worth, i, found = max(tried, key=lambda of: of[0])
        if worth < MIN_SCORE:
            continue
        ends.append((i, int(k)))
        motions.append(found.motion)
        informations.append(np.linalg.inv(blur(found.covariance)))
        shifts.append(compose(compose(poses[i], found.motion), inverse(poses[k])))
        worths.append(worth)
    if not shifts:
        return NO_LINKS
    moved = np.array([[*transform(shift, middle), shift[2]] for shift in shifts])
    apart = np.abs(moved[:, None] - moved[None])
    apart[..., 2] = np.abs(wrap_angle(apart[..., 2]))
    agree = (np.hypot(apart[..., 0], apart[..., 1]) < AGREE_M) & (apart[..., 2] < AGREE_RAD)
    best = int(np.argmax(agree @ np.array(worths)))
    if agree[best].sum() < max(2, MIN_AGREEING * len(tries)) or agree[best] @ np.array(worths) < MIN_TOGETHER:
        return NO_LINKS
    return Links.of(np.array(ends), np.array(motions), np.array(informations), robust=True)[np.flatnonzero(agree[best])]
